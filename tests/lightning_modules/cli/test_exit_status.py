"""What every verb ends with: one line on stderr, 2 for wrong use and 1 for a file that is to blame; nothing written."""

import io
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from lightning_modules.__main__ import main
from lightning_modules.cli import folder_lock
from lightning_modules.cli.errors import as_one_line
from lightning_modules.cli.folder_lock import FolderError, locked_folder
from spikekit import write_spikes


def _of_another_scale():
    torch.save({"state_dict": {}, "network": {"class": "CSCSR", "scale": 2}}, file := io.BytesIO())
    return file.getvalue()


OVERLAY = "model: {network: {init_args: {width: 4, representation_width: 4, features: 1, stages: 1, end_blocks: 1}}}"
FILES = {
    "tiny.yaml": OVERLAY.encode(),
    "bad.yaml": b"model: [1\n",
    "list.yaml": b"[1, 2]",
    "deep.yaml": b"[" * 100_000,
    "odd.yaml": b"model: {network: {class_path: CSCSR, init_args: {motion: nonsense.Estimator}}}",
    "cut.ckpt": b"PK\3\4 and no more",
    "other.ckpt": _of_another_scale(),
    "cut.safetensors": b"\xff" * 30,
    "odd.dat": bytes(range(256)),
    "a.txt": b"text",
}

HOLDER = """
import sys, time
from lightning_modules.cli.folder_lock import locked_folder
with locked_folder(sys.argv[1], "lightning predict", ".predict.lock"):
    print("held", flush=True)
    time.sleep(600)
"""


def _rows():
    x4 = "-c {configs}/x4.yaml -c tiny.yaml"
    wrong = [
        "",
        "nonsense",
        "fit --nonsense 3",
        "fit",
        "fit -c",
        "fit -c nowhere.yaml",
        f"fit {x4} -c odd.yaml",
        f"fit {x4} --model.network.motion nonsense",
        f"fit {x4} --model.network.motion torch.nn.Linear",
        f"fit {x4} --model.network.motion '{{{{class_path: ZeroFlow, init_args: {{{{a: 3}}}}}}}}'",
        f"fit {x4} --model.network.width abc",
        f"fit {x4} --model.network.width -3",
        f"validate {x4} --data Nonsense",
        f"test {x4} -o a.txt",
        "predict --speed nonsense",
        "predict a.dat -o out --nonsense 3",
        "predict a.dat -o out --speed fast --weights cscsr_tiny_x4",
        "sweep",
        "sweep {configs}/x4.yaml --steps abc",
        "sweep {configs}/x4.yaml --set a=3",
        "trade -c {configs}/x4.yaml --rounds 0",
        "trade -c {configs}/x4.yaml -c odd.yaml",
        "export --nonsense",
        "models x",
    ]
    failed = [
        (f"fit {x4} -c bad.yaml", "bad.yaml"),
        (f"fit {x4} -c list.yaml", "list.yaml"),
        ("sweep {configs}/x4.yaml -c deep.yaml", "deep.yaml"),
        (f"fit {x4} --ckpt_path cut.ckpt -o out", "cut.ckpt"),
        (f"validate {x4} --ckpt_path nowhere.ckpt", "nowhere.ckpt"),
        *(
            (f"{verb} {x4} --data.val_clips 1 --ckpt_path other.ckpt -o out", "other.ckpt was trained with scale=2")
            for verb in ("validate", "test")
        ),
        (f"test {x4} --model.weights cut.safetensors -o out", "cut.safetensors"),
        (f"fit {x4} --data.root nowhere", "nowhere"),
        ("predict nowhere.dat -o out", "nowhere.dat"),
        ("predict --weights cscsr_tiny_x4 odd.dat --height 7 --width 9 -o out", "odd.dat"),
        ("predict odd.dat --height 7 --width 9 -o out -c bad.yaml", "bad.yaml"),
        ("adapt nowhere.dat -o out", "nowhere.dat"),
        ("trade -c {configs}/x4.yaml --ckpt_path cut.ckpt", "cut.ckpt"),
        ("export cut.ckpt -o a.safetensors", "cut.ckpt"),
    ]
    return [(words, 2, "") for words in wrong] + [(words, 1, name) for words, name in failed]


@pytest.mark.parametrize(("words", "status", "named"), _rows())
def test_one_line(words, status, named, configs, tmp_path, monkeypatch, capfd):
    for name, content in FILES.items():
        (tmp_path / name).write_bytes(content)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["lightning"])
    with pytest.raises(SystemExit) as end:
        main(shlex.split(words.format(configs=configs)))
    said = capfd.readouterr().err
    if isinstance(end.value.code, str):  # which Python prints, and then ends with 1
        said += end.value.code + "\n"
    assert (1 if isinstance(end.value.code, str) else end.value.code) == status, said
    assert said.startswith("lightning: ")
    assert len(said.splitlines()) == 1, said
    assert named in said
    assert "Traceback" not in said
    assert {path.name for path in tmp_path.iterdir()} == set(FILES)


def test_two_trainings_in_one_folder(configs, tmp_path, monkeypatch):
    """The second would write over the first one's checkpoints."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["lightning"])
    (tmp_path / "tiny.yaml").write_bytes(FILES["tiny.yaml"])
    words = f"fit -c {configs}/x4.yaml -c tiny.yaml --data.train_clips 4 --data.patch 8 --data.val_clips 1 -o out"
    with locked_folder("out", "run"), pytest.raises(SystemExit, match="out: another run is at work here"):
        main(words.split())
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"lock"}


@pytest.mark.parametrize("verb", ["test", "predict", "trade"])
def test_two_runs_of_a_verb_in_one_folder(verb, configs, tmp_path, monkeypatch):
    """One of them would go on with what the other writes; before anything is computed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["lightning"])
    words = f"{verb} -c {configs}/x4.yaml --data.val_clips 1" + " --setting a:" * (verb == "trade")
    if verb == "predict":
        write_spikes("a.npz", torch.zeros(41, 4, 4))
        words = "predict a.npz --speed fastest --calibration none"
    held = "lock" if verb == "trade" else f".{verb}.lock"
    for output, folder in (("out", "out"), *([("film.mp4", "film.mp4.frames")] if verb == "predict" else [])):
        said = rf"^lightning: {folder}: another lightning {verb} is at work here; -o goes elsewhere$"
        with locked_folder(folder, "run", held), pytest.raises(SystemExit, match=said):
            main([*words.split(), "-o", output])
        assert {path.name for path in (tmp_path / folder).iterdir()} == {held}


def test_a_training_does_not_keep_predictions_out(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_spikes("a.npz", torch.zeros(41, 4, 4))
    with locked_folder("out", "run"):
        main(["predict", "a.npz", "--speed", "fastest", "--calibration", "none", "-o", "out"])
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"lock", ".predict.lock", "frame_000020.png"}


@pytest.mark.parametrize(("output", "folder"), [("out", "out"), ("film.gif", "film.gif.frames")])
def test_the_lock_of_another_process_goes_with_it(output, folder, tmp_path, monkeypatch):
    pytest.importorskip("av")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["lightning"])
    write_spikes("a.npz", torch.zeros(41, 4, 4))
    words = "predict a.npz --speed fastest --calibration none -o"
    with subprocess.Popen([sys.executable, "-c", HOLDER, folder], stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"held\n"
        with pytest.raises(SystemExit, match=f"^lightning: {folder}: another lightning predict is at work here"):
            main([*words.split(), output])
        other.kill()
    main([*words.split(), output])
    assert (tmp_path / ("out/frame_000020.png" if output == "out" else output)).is_file()


def test_a_folder_that_cannot_be_locked(tmp_path, monkeypatch):
    (tmp_path / "lock").mkdir()
    with (
        pytest.raises(FolderError, match=rf"^-o: {tmp_path}/lock: expected the file of a lock"),
        locked_folder(tmp_path, "run"),
    ):
        pass
    (tmp_path / "lock").rmdir()
    with monkeypatch.context() as patch:

        def refuse(*_):
            raise NotImplementedError("no locks here")

        patch.setattr(folder_lock.FileLock, "acquire", refuse)
        with locked_folder(tmp_path, "run"):  # a file system without locks
            pass


def test_a_disk_that_refuses_is_failed_work():
    with pytest.raises(SystemExit) as ended, as_one_line():
        raise OSError(28, "No space left on device", "a.png")
    assert ended.value.code == "lightning: a.png: No space left on device"  # Python prints it and ends with 1
    with pytest.raises(SystemExit, match=r"^lightning: No room$"), as_one_line():
        raise OSError(28, "No room")
    with pytest.raises(OSError, match="no errno"), as_one_line():  # a fault of the program
        raise OSError("no errno")


@pytest.mark.parametrize("words", ["--help", "--version", "models"])
def test_nobody_reads_what_is_printed(words):
    """As with ``| head -1``, but without a race."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "lightning_modules", *words.split()]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, timeout=120)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_what_is_printed_finds_no_room():
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "lightning_modules", "models"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (1, "lightning: No space left on device\n")

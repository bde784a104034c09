"""Errors of every verb: one line on stderr, status 2 for wrong use and 1 for bad files, and nothing written."""

import io
import os
import subprocess
import sys
from unittest.mock import Mock

import pytest
import torch

from lightning_modules.__main__ import main
from lightning_modules.cli import folder_lock
from lightning_modules.cli.errors import InputError, as_one_line
from lightning_modules.cli.folder_lock import locked_folder
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
    "red.yaml": b'data: {root: "\\e[31mred"}',
    "cut.ckpt": b"PK\3\4 and no more",
    "other.ckpt": _of_another_scale(),
    "cut.safetensors": b"\xff" * 30,
    "odd.dat": bytes(range(256)),
    "a.txt": b"text",
}

X4 = "-c x4 -c tiny.yaml"
WRONG = {
    "": "expected a verb, one of fit, validate",
    "nonsense": "got nonsense",
    "fit": "expected a network: a configuration that names one, such as -c x4",
    "fit -c quick": "expected a network: a configuration that names one, such as -c x4",
    "fit -c nowhere.yaml": "nowhere.yaml",
    f"fit {X4} -c odd.yaml": "No module named 'nonsense'",
    f"fit {X4} --model.network.motion torch.nn.Linear": "not correspond to a subclass of MotionEstimator",
    f"fit {X4} --model.network.motion {{": "model.network.motion",
    f"fit {X4} --model.network ClassicalDecoder": "expected a network that learns, got ClassicalDecoder",
    f"fit {X4} --model.optimizer.lr -1": "Invalid learning rate",
    f"fit {X4} --data.patern RGGB": "data: Option 'patern' is not accepted",
    f"fit {X4} --data.pattern BGGR": "data.pattern: expected RGGB",
    f"validate {X4} --data.val_clips 1 --data.alpha 0.2": "data.alpha: expected 0.4, the value of model.network",
    f"fit {X4} --data.flow_patch 64": "data.flow_patch: expected 0, as model.flow sets it, got 64",
    f"fit {X4} --data.flow_times [3,35]": "data.flow_times: expected [5, 35], those of the network, got [3, 35]",
    "fit -c flow --data.frames 51": "data.frames: expected 41, the value of the model, got 51",
    f"fit {X4} --data.workers -1": "workers: expected 0 or more, got -1",
    f"fit {X4} --trainer.logger WandbLogger": "Requirement 'wandb",
    f"fit {X4} --trainer.accelerator cpu --trainer.devices -1": "devices",
    f"fit {X4} --trainer.callbacks Foo": "trainer.callbacks: expected the name of a class, got Foo",
    f"test {X4} -o a.txt": "-o: expected a folder, got the file",
    "predict a.dat -o out --speed nonsense": "nonsense",
    "predict a.dat -o out --speed fast --weights cscsr_tiny_x4": "--speed",
    "sweep x4 --steps abc": "abc",
    "sweep x4 --set a=3": "a=3",
    "trade -c x4 --rounds 0": "rounds",
    "models x": "x",
}
FAILED = {
    f"fit {X4} -c bad.yaml": "bad.yaml",
    f"fit {X4} -c list.yaml": "list.yaml",
    "sweep x4 -c deep.yaml": "deep.yaml",
    f"fit {X4} --ckpt_path cut.ckpt -o out": "cut.ckpt",
    f"test {X4} --ckpt_path best": "best.ckpt: no such checkpoint",
    f"validate {X4} --data.val_clips 1 --ckpt_path other.ckpt -o out": "other.ckpt was trained with scale=2",
    f"test {X4} --model.weights cut.safetensors -o out": "cut.safetensors",
    f"test {X4} --model.weights gone/best.ckpt": "gone/best.ckpt: no such file of weights\n",
    f"test {X4} --model.weights spike2flow": "motion Spike2Flow --model.network.motion.weights spike2flow",
    f"fit {X4} --data.root nowhere": "nowhere",
    f"fit {X4} -c red.yaml": "?[31mred",
    "predict nowhere.dat -o out": "nowhere.dat",
    "predict --weights cscsr_tiny_x4 odd.dat --height 7 --width 9 -o out": "odd.dat",
    "predict odd.dat --height 7 --width 9 -o out -c bad.yaml": "bad.yaml",
    "adapt nowhere.dat -o out": "nowhere.dat",
    "export cut.ckpt -o a.safetensors": "cut.ckpt",
    "export cscsr_tiny_x4 --format onnx -o a.pt2": "-o: expected a file name ending in .onnx for onnx, got a.pt2",
}
ROWS = [(words, 2, said) for words, said in WRONG.items()] + [(words, 1, said) for words, said in FAILED.items()]


@pytest.mark.parametrize(("words", "status", "named"), ROWS)
def test_errors_are_one_line(words, status, named, tmp_path, monkeypatch, capfd):
    for name, content in FILES.items():
        (tmp_path / name).write_bytes(content)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(words.split())
    said = capfd.readouterr().err
    if isinstance(end.value.code, str):  # which Python prints, and then ends with 1
        said += end.value.code + "\n"
    assert (1 if isinstance(end.value.code, str) else end.value.code) == status, said
    assert said.startswith("lightning: ")
    assert len(said.splitlines()) == 1, said
    assert named in said
    assert "Traceback" not in said
    assert "\x1b" not in said
    assert {path.name for path in tmp_path.iterdir()} == set(FILES)


SOON = "predict a.npz --speed fastest --calibration none -o"


@pytest.mark.parametrize(
    ("words", "folder", "name"),
    [
        (f"fit {X4} --data.train_clips 4 --data.patch 8 --data.val_clips 1 -o out", "out", "lock"),
        ("test -c x4 --data.val_clips 1 -o out", "out", ".test.lock"),
        ("sweep x4 -c tiny.yaml -o out", "out", "lock"),
        ("trade -c x4 --data.val_clips 1 --setting a: -o out", "out", "lock"),
        (f"{SOON} out", "out", ".predict.lock"),
        (f"{SOON} film.mp4", "film.mp4.frames", ".predict.lock"),
    ],
)
def test_second_run_in_a_folder_is_rejected(words, folder, name, tmp_path, monkeypatch):
    """Before anything is computed, as one run would continue with files of the other."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.yaml").write_bytes(FILES["tiny.yaml"])
    write_spikes("a.npz", torch.zeros(41, 4, 4))
    with locked_folder(folder, "run", name), pytest.raises(SystemExit, match=f"{folder}: another .* uses this folder"):
        main(words.split())
    assert {path.name for path in (tmp_path / folder).iterdir()} == {name}


def test_folder_that_cannot_be_locked(tmp_path, monkeypatch):
    (tmp_path / "lock").mkdir()
    with (
        pytest.raises(InputError, match=rf"^-o: {tmp_path}/lock: expected a lock file"),
        locked_folder(tmp_path, "run"),
    ):
        pass
    (tmp_path / "lock").rmdir()

    def refuse(*_):
        raise NotImplementedError("no locks here")

    monkeypatch.setattr(folder_lock.FileLock, "acquire", refuse)
    with locked_folder(tmp_path, "run"):  # a file system without locks
        pass


def test_full_disk_ends_with_status_1():
    with pytest.raises(SystemExit) as ended, as_one_line():
        raise OSError(28, "No space left on device", "a.png")
    assert ended.value.code == "lightning: a.png: No space left on device"  # Python prints it and ends with 1
    with pytest.raises(SystemExit, match=r"^lightning: No room$"), as_one_line():  # on standard output
        raise OSError(28, "No room")
    with pytest.raises(OSError, match="no errno"), as_one_line():  # a fault of the program
        raise OSError("no errno")


def test_closed_standard_output():
    """As with ``| head -1``, but without a race; at exit, Triton's bindings do not report what is kept as leaks."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "lightning_modules", "fit", "-c", "x4", "--print_config"]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, timeout=120)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")


def test_ctrl_c_while_torch_is_imported(monkeypatch, capsys):
    with monkeypatch.context() as patch:
        patch.setattr("builtins.__import__", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(SystemExit, match="130"):
            main(["export"])
    assert capsys.readouterr().err == "lightning: stopped by Ctrl-C\n"

"""The ``spikekit`` command line."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from spikekit import bin_to_sensor, psnr, read_picture, read_spikes, spike_integrate_fire, tfi, tfp, write_spikes
from spikekit.cli.command import VERBS, main

COMMAND = [sys.executable, "-c", "from spikekit.cli.command import main; raise SystemExit(main())"]


def expose(light, frames):
    """Record a still scene with a simulated camera."""
    spikes, _ = spike_integrate_fire(light.expand(frames, *light.shape), charge=torch.rand(light.shape))
    return spikes


def command(*words):
    assert main([str(word) for word in words]) == 0


@pytest.fixture
def clip(tmp_path):
    """A recording of 60 frames of 12 x 20, brighter from left to right and dark at the top left."""
    light = torch.linspace(0.1, 0.5, 20).repeat(12, 1)
    light[0, 0] = 0
    write_spikes(tmp_path / "clip.dat", expose(light, 60))
    return tmp_path / "clip.dat"


def sized(path, height=12, width=20):
    return path, "--height", height, "--width", width


# --- info and cameras -------------------------------------------------------------------------------------------------


def test_info_prints_size_and_statistics(clip, capsys):
    command("info", *sized(clip))
    out, err = capsys.readouterr()
    assert err == ""
    for line in (
        f"file         {clip}",
        "size         12 x 20 (H x W), 1800 bytes",
        "frames       60, 3 ms at 20 kHz",
        f"bits set     {read_spikes(clip, 12, 20).sum()} of 14400, ",
        "darkest      0.0000 spikes per frame, at row 0, column 0",
        "brightest    0.5000 spikes per frame, at row ",
        "never fire   1 of 240 pixels, 0.42%",
        "always fire  0 of 240 pixels, 0.00%",
    ):
        assert f"\n{line}" in f"\n{out}"


def test_cameras_are_listed(capsys):
    command("cameras")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["camera", "m1k40", "m1k40-bayer", "uhsr", "vidar"]
    assert "992 x 992" in lines[2]
    assert "BGGR" in lines[2]


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        (12_500 * 301, "250 x 400 (vidar: 301 frames) divides its 3762500 bytes exactly"),
        (250_000, "250 x 400 (vidar: 20 frames) and 1000 x 1000 (m1k40 or m1k40-bayer: 2 frames) divide its"),
        (30, "none of 250 x 250, 250 x 400, 250 x 416, 1000 x 1000, 1000 x 1024 divides its 30 bytes exactly"),
    ],
)
def test_headerless_recording_needs_a_size(tmp_path, fails, size, expected):
    path = tmp_path / "a.dat"
    path.touch()
    os.truncate(path, size)
    for words in (["info", path], ["decode", path, "--height", 250, "-o", tmp_path / "a.png"]):
        err = fails(2, *words)
        assert f"{path}: a .dat has no header, give --height and --width" in err
        assert expected in err


# --- decode -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("method", "least"), [("tfi", 20), ("tfp", 30)])
def test_decode_recovers_the_scene(clip, tmp_path, capsys, method, least):
    """The scene is recovered: with alpha at its own brightness, without it scaled to white."""
    out = tmp_path / "made" / "a.png"
    words = ["decode", *sized(clip), "--method", method, "-o", out]
    light = torch.linspace(0.1, 0.5, 20).repeat(3, 12, 1)
    command(*words, "--alpha", "0.5")
    assert capsys.readouterr().out.endswith("divided by alpha 0.5\n")
    assert psnr(read_picture(out)[:, 1:], light[:, 1:] / 0.5) > least
    command(*words)
    report = capsys.readouterr().out
    assert report.startswith(f"{out}: frame 30 of 60 by {method} from up to ")
    assert 1.9 < float(report.split("multiplied by ")[1].split(",")[0]) <= 2
    assert psnr(read_picture(out)[:, 1:], light[:, 1:] / 0.5) > least


@pytest.mark.parametrize("name", ["a.dat", "a.npz"])
@pytest.mark.parametrize(
    ("words", "decode"),
    [
        ([], tfi),
        (["--window", "41"], lambda spikes: tfp(spikes, 41)),
        (["--window", "13", "--order", "3"], lambda spikes: tfp(spikes, 13, order=3)),
    ],
)
@pytest.mark.parametrize("frames", ["0:500:83", "498:", "250"])
def test_pictures_equal_those_of_the_whole_recording(tmp_path, capsys, name, words, decode, frames):
    """For one frame or many, with their numbers in the names, for every method."""
    spikes = expose(torch.rand(12, 9) * 0.5 + 0.05, 500)
    write_spikes(tmp_path / name, spikes)
    out = tmp_path / "out"
    command(
        "decode", *sized(tmp_path / name, 12, 9), *words, "--frame", frames, "-o", out / "a{frame}.png", "--alpha", 0.6
    )
    chosen = range(500)[slice(*[int(part) if part else None for part in frames.split(":")])] if ":" in frames else [250]
    assert capsys.readouterr().err == ""
    assert sorted(path.name for path in out.iterdir()) == [f"a{n:03}.png" for n in chosen]
    whole = (decode(spikes) / 0.6).clamp(0, 1)
    for n in chosen:
        assert torch.equal((read_picture(out / f"a{n:03}.png")[0] * 255).round(), (whole[n] * 255).round())


BOUNDED = """
import resource, sys
from spikekit.cli.command import main

def run(frames):
    line = ["decode", sys.argv[1], "--height", "50", "--width", "80", "--method", "tfi", "-o", sys.argv[2]]
    assert main([*line, "--frame", frames]) == 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

before = run("0:1000:250")
print(run("0::1000") - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="kilobytes of ru_maxrss are Linux's")
def test_many_pictures_are_decoded_in_bounded_memory(tmp_path):
    """20,000 frames, or 80 MB, take at most 8 MB more than 1000 frames."""
    chunk = (torch.rand(200, 50, 80) < 0.2).byte()
    write_spikes(tmp_path / "a.dat", (chunk for _ in range(100)))
    done = subprocess.run(
        [sys.executable, "-c", BOUNDED, tmp_path / "a.dat", tmp_path / "{frame}.png"],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"MALLOC_MMAP_THRESHOLD_": "131072"},  # what is freed is given back, and no longer counts
    )
    assert int(done.stdout.splitlines()[-1]) < 8000


@pytest.mark.parametrize("pattern", ["GRBG", "bggr"])
def test_decode_keeps_the_colour_of_a_wall(tmp_path, pattern, monkeypatch):
    """A coloured wall, stored upside down, keeps its colour; ``~`` is expanded."""
    monkeypatch.setenv("HOME", str(tmp_path))
    rgb = torch.tensor([0.9, 0.5, 0.2])[:, None, None].expand(3, 10, 14)
    raw = bin_to_sensor(rgb, pattern.upper(), scale=1)
    write_spikes(tmp_path / "a.dat", expose(0.4 * raw, 200), flip=True)
    words = ["--flip", "--window", 199, "--alpha", 0.4, "--pattern", pattern, "-o", tmp_path / "a.png"]
    command("decode", *sized(tmp_path / "a.dat", 10, 14), *words)
    assert (read_picture(tmp_path / "a.png") - rgb).abs().max() < 0.06
    command("decode", *sized("~/a.dat", 10, 14), *words[:-1], "~/b.tif", "--bits", 16)
    assert (read_picture(tmp_path / "b.tif") - read_picture(tmp_path / "a.png")).abs().max() < 1 / 500
    command("decode", *sized("~/a.dat", 10, 14), *words[:-1], "~/b.jpg", "--quality", 90)
    assert (read_picture(tmp_path / "b.jpg") - rgb).abs().mean() < 0.06


# --- what is assumed, and said; what cannot be used -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "words", "noted"),
    [((250, 400), [], "vidar"), ((250, 400), ["--flip"], None), ((1000, 1000), [], "m1k40"), ((12, 20), [], None)],
)
def test_frames_that_are_likely_upside_down_are_noted(tmp_path, capsys, size, words, noted):
    write_spikes(tmp_path / "a.dat", torch.ones(3, *size))
    command("info", *sized(tmp_path / "a.dat", *size), *words)
    said = capsys.readouterr().err
    assert said.count("\n") == (noted is not None)
    assert noted is None or (noted in said and "--flip" in said)


@pytest.mark.parametrize("save", [np.save, np.savez])
def test_recording_with_time_last_is_noted(tmp_path, capsys, save):
    path = tmp_path / ("a.npy" if save is np.save else "a.npz")
    for shape, words, status in (
        ((250, 400, 90), [], 1),  # the size of a camera
        ((12, 20, 90), ["--height", "12", "--width", "20"], 1),
        ((30, 40, 200), [], 0),
    ):
        save(path, np.zeros(shape, bool))
        assert main(["info", str(path), *words]) == status
        assert "(H, W, T)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "required: VERB (see spikekit --help)"),
        (["decode", "a.dat"], "required: -o/--output (see spikekit decode --help)"),
        (["decode", "CLIP", "--fast"], "unrecognized arguments: --fast (see spikekit decode --help)"),
        (["--fast", "info", "a.dat"], "unrecognized arguments: --fast (see spikekit --help)"),
        (["decode", "CLIP", "--frame", "1:-2"], "expected a whole number, 0 or more, or A:B or A:B:STEP, got 1:-2"),
        *(
            (["decode", "CLIP", "--frame", n], f"expected frames within 0 .. 59, got {n}")
            for n in ("60", "60:", "0:61")
        ),
        (["decode", "CLIP", "--frame", "0:3"], "--output: expected {frame} in the name of 3 pictures, got "),
        (["decode", "CLIP", "--window", "4"], "odd number, with --method tfp, got 4"),
        (["decode", "CLIP", "--method", "tfi", "--order", "3"], "expected --method tfp, got 3 with tfi"),
        (["decode", "CLIP", "-o", "a.dat"], "ends in .png, .jpg, .jpeg, .bmp, .tif, .tiff, .pgm, .ppm, .pnm, got"),
    ],
)
def test_wrong_command_lines_give_one_line(clip, fails, words, message):
    if "CLIP" in words:
        words = [words[0], *sized(clip), "-o", clip.with_suffix(".png"), *words[2:]]
    assert message in fails(2, *words)


def test_wrong_files_give_one_line(clip, tmp_path, fails):
    (tmp_path / "clip.raw").write_bytes(b"raw")
    (tmp_path / "folder.png").mkdir()
    for path, message in [
        (sized(tmp_path / "none.dat"), "none.dat: no such file"),
        ((tmp_path / "clip.raw",), "clip.raw: expected a recording that ends in .dat, .npy, .npz, got .raw"),
    ]:
        assert message in fails(1, "info", *path)
        assert message in fails(1, "decode", *path, "--method", "tfi", "-o", tmp_path / "a.png")
    assert not (tmp_path / "a.png").exists()
    for out in (tmp_path / "folder.png", clip / "a.png"):
        assert f"{out}: " in fails(1, "decode", *sized(clip), "--method", "tfp", "-o", out)
    assert "bits" in fails(1, "decode", *sized(clip), "--bits", "16", "-o", tmp_path / "b.jpg")


# --- as a process -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("words", [["--help"], *([verb, "--help"] for verb in VERBS)])
def test_help_has_an_example_for_every_verb(words, capsys):
    command(*words)
    out = capsys.readouterr().out
    assert out.startswith("usage: spikekit")
    assert ("example:\n  spikekit " in out) == (len(words) == 2)


def forked(*words, out, said):
    """Start the command in a process of its own, which has imported all that this one has; it prints ASCII to files."""

    def run():
        for number, path in ((1, out), (2, said)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), number)
        sys.stdout, sys.stderr = (open(number, "w", encoding="ascii", closefd=False) for number in (1, 2))  # noqa: SIM115
        raise SystemExit(main([*map(str, words)]))

    process = multiprocessing.get_context("fork").Process(target=run)
    process.start()
    return process


def test_control_characters_in_names_are_not_printed(clip, tmp_path):
    name, out, said = tmp_path / "r\x1b[31med ä.dat", tmp_path / "out", tmp_path / "said"
    name.write_bytes(clip.read_bytes())
    process = forked("info", *sized(name), out=out, said=said)
    process.join()
    assert (process.exitcode, said.read_text()) == (0, "")
    assert "?[31med" in out.read_text()
    assert out.read_text().isascii()


def test_broken_pipe():
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([*COMMAND, "cameras"], stdout=writer, stderr=subprocess.PIPE, text=True, timeout=120)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a system without /dev/full")
def test_full_standard_output(clip, tmp_path):
    process = forked("info", *sized(clip), out="/dev/full", said=tmp_path / "said")
    process.join()
    said = (tmp_path / "said").read_text()
    assert (process.exitcode, said) == (1, "spikekit: standard output: No space left on device\n")


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_complete_files_are_kept_when_interrupted(tmp_path, number, status):
    with open(tmp_path / "a.dat", "wb") as file:
        file.truncate(250 * 400 // 8 * 9000)  # minutes of work, and no room on the disk
    words = ["decode", *sized(tmp_path / "a.dat", 250, 400), "--flip", "--frame", ":", "--alpha", "1", "--window", "1"]
    said = tmp_path / "said"
    running = forked(*words, "-o", tmp_path / "out" / "{frame}.png", out=os.devnull, said=said)
    while not (tmp_path / "out" / "0002.png").exists():
        assert running.is_alive()
        time.sleep(0.05)
    os.kill(running.pid, number)
    running.join(60)
    assert (running.exitcode, said.read_text().count("\n")) == (status, 1)
    for picture in (tmp_path / "out").iterdir():
        assert picture.suffix == ".png"
    assert read_picture(picture).shape == (3, 250, 400)

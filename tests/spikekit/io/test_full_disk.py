"""Every file that spikekit writes, on a full disk; `spikekit simulate` has its own tests, as it writes several."""

import pytest
import torch

from spikekit import write_picture, write_spikes, write_video
from spikekit.calibration.calibration import Calibration
from spikekit.calibration.files import write_calibration
from spikekit.cli.command import main

SPIKES = (torch.rand(200, 64, 64, generator=torch.Generator().manual_seed(0)) < 0.4).to(torch.uint8)
PICTURE = torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(1))


def film(path):
    pytest.importorskip("av")
    write_video(path, [PICTURE.roll(9 * n, -1) for n in range(4)])


def calibration(path):
    write_calibration(path, Calibration(torch.ones(64, 64), torch.zeros(64, 64), torch.zeros(64, 64).byte()))


@pytest.mark.parametrize(
    ("name", "write"),
    [
        *((f"a{ending}", lambda path: write_picture(path, PICTURE)) for ending in (".png", ".jpg", ".webp", ".bmp")),
        ("a.dat", lambda path: write_spikes(path, SPIKES)),
        ("a.npz", lambda path: write_spikes(path, SPIKES)),
        ("a.npz", lambda path: write_spikes(path, SPIKES.split(30))),
        ("a.calibration.safetensors", calibration),
        *((f"a{ending}", film) for ending in (".mp4", ".mov", ".mkv", ".gif")),
    ],
)
def test_a_file_stays_whole(name, write, stays_whole):
    stays_whole(name, write)


def command(capsys, *words):
    """Run it; what it says where it fails is raised."""
    if main([str(word) for word in words]):
        raise ValueError(capsys.readouterr().err.strip())


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a.png", ("decode", "{clip}", "--method", "tfi")),
        ("b.png", ("view", "{clip}", "--window", "9")),
    ],
)
def test_a_command_leaves_nothing_half_written(name, words, stays_whole, tmp_path_factory, capsys):
    clip = tmp_path_factory.mktemp("clip") / "clip.npz"
    write_spikes(clip, SPIKES[:40])
    words = [word.format(clip=clip) for word in words]
    stays_whole(name, lambda path: command(capsys, *words, "-o", path), rooms=(5,))

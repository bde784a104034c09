"""All files that spikekit writes, on a full disk; `spikekit simulate`, which writes several, is tested elsewhere."""

import pytest
import torch

from spikekit import write_picture, write_spikes, write_video
from spikekit.calibration.calibration import Calibration, write_calibration
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
def test_existing_file_is_kept(name, write, stays_whole):
    stays_whole(name, write)


@pytest.mark.parametrize("words", [("decode", "--method", "tfi"), ("view", "--window", "9")])
def test_commands_leave_no_partial_files(words, stays_whole, tmp_path_factory, capsys):
    clip = tmp_path_factory.mktemp("clip") / "clip.npz"
    write_spikes(clip, SPIKES[:9])

    def run(path):
        if main([words[0], str(clip), *words[1:], "-o", str(path)]):
            raise ValueError(capsys.readouterr().err.strip())

    stays_whole("a.png", run, rooms=(5,))

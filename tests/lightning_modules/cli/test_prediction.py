"""What ``lightning predict`` says about its choice before it begins."""

import pytest
import torch

from lightning_modules.cli.prediction import _choice
from spikekit import spike_integrate_fire, write_spikes


@pytest.mark.parametrize(
    ("white", "speed", "hint"), [(0.05, "fastest", True), (0.4, "fastest", False), (0.05, "fast", False)]
)
def test_a_decoder_of_a_dark_recording_is_said_to_be_noisy(white, speed, hint, tmp_path):
    charge = torch.rand(8, 8, generator=torch.Generator().manual_seed(0))
    write_spikes(tmp_path / "a.npz", spike_integrate_fire(torch.full((200, 8, 8), white), charge=charge)[0])
    preset, said = _choice(["predict", "--data", "Recording", "--data.path", str(tmp_path / "a.npz"), "--speed", speed])
    assert bool(preset.method) == (speed == "fastest")
    assert ("a white pixel fires 3.0 times in 41 frames" in said) == hint
    assert ("noisy" in said) == hint

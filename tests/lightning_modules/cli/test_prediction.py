"""What ``lightning predict`` says about its choice before it begins."""

import pytest
import torch

from lightning_modules.cli.prediction import _choice, _interpolated, with_choice
from lightning_modules.inference.presets import Preset
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
    assert ("picture is noisy" in said) == hint


@pytest.mark.parametrize(
    ("white", "frame", "clip", "hint"),
    [(0.05, None, 41, True), (0.05, "50:150", 101, False), (0.05, "50:151", 41, True), (0.4, None, 41, False)],
)
def test_longer_clips_are_chosen_or_hinted_at_in_little_light(white, frame, clip, hint, tmp_path):
    charge = torch.rand(8, 8, generator=torch.Generator().manual_seed(0))
    write_spikes(tmp_path / "a.npz", spike_integrate_fire(torch.full((200, 8, 8), white), charge=charge)[0])
    words = ["predict", "--data", "Recording", "--data.path", str(tmp_path / "a.npz"), "--speed", "best"]
    preset, said = _choice([*words, *([] if frame is None else ["--data.frame", frame])])
    assert preset.clip == clip
    assert ("dB better: --data.frame 50:150 leaves room for them" in said) == hint


@pytest.mark.parametrize(
    ("every", "speed", "interpolated"),
    [
        (1, "balanced", 11),
        (3, "fast", 3),
        (6, "fast", 1),
        (3, "best", 1),
        (4, "best", 0),
        (20, "fast", 0),
        (3, "fastest", 0),
    ],
)
def test_pictures_close_to_each_other_are_interpolated(every, speed, interpolated, tmp_path):
    write_spikes(tmp_path / "a.npz", torch.rand(200, 8, 8) < 0.3)
    words = ["predict", "--data", "Recording", "--data.path", str(tmp_path / "a.npz"), "--data.every", str(every)]
    preset, said = _choice([*words, "--speed", speed])
    assert (preset.interpolated or 0) == interpolated
    hint = f"{interpolated} of {interpolated + 1} pictures are interpolated, being {every} frames apart"
    assert (hint in said) == (interpolated > 0)


def test_pictures_without_motion_are_not_interpolated(tmp_path):
    assert _interpolated(Preset("cscsr_small_x4", motion="ZeroFlow"), 3, "fast") == 0
    assert _interpolated(Preset("cscsr_small_x4"), 3, "fast") == 3
    assert _interpolated(Preset("cscsr_small_x4"), 3, None) == 1
    write_spikes(tmp_path / "a.npz", torch.rand(200, 8, 8) < 0.3)
    data = ["--data", "Recording", "--data.path", str(tmp_path / "a.npz"), "--data.frame", "60:120:3"]
    choice, _ = with_choice(None, ["predict", *data, "--speed", "balanced", "--model.interpolated", "0"])
    assert choice.index("3") < choice.index("0")  # what is asked for stands behind and wins

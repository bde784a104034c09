"""Known output of the simulator for a fixed film; other output requires another ``SIMULATOR_VERSION``."""

import hashlib

import numpy as np
import pytest
import torch

from lightning_modules.data.layouts import SequenceFiles
from lightning_modules.data.sequences import ClipRecipe
from spikekit import Blend, FrameSequence, SensorNoise, write_picture
from spikekit.scenes.frame_sequence import SIMULATOR_VERSION

#: by version, of which only the newest is ever tried
KNOWN = {
    1: {
        "clip": "227a2e32d87ffc18f9dc363c1059046acfecd3c39cb8ac84d4f257e7c45f37b5",
        "noise": 3291,
        "light": [0.1998, 0.1937, 0.2085, 0.2032, 0.2924, 0.0760, 0.1960, 0.0855, 0.3536],
        "flow": [
            -0.6028, -0.5966, -0.5974, -0.6010, -0.5977, -0.5983, -0.5971, -0.5922, -0.5936,
            -0.0011, -0.0017, -0.0013, -0.0023, -0.0009, 0.0001, -0.0071, -0.0075, -0.0058,
        ],
    },
}  # fmt: skip
EXPECTED = KNOWN[SIMULATOR_VERSION]

CHANGED = "the simulator's output has changed: count up SIMULATOR_VERSION, and write down here what it is now"


@pytest.fixture
def film(tmp_path):
    """Blocks that move and flicker, in files whose every byte is known."""
    blocks = np.random.default_rng(7).integers(0, 2, (4, 6, 3)).repeat(8, 0).repeat(8, 1)
    names = []
    for n in range(5):
        shade = 255 - 32 * (n % 2)
        names.append(f"{n}.bmp")
        write_picture(tmp_path / names[-1], torch.from_numpy(np.roll(blocks, 2 * n, 1) * shade).permute(2, 0, 1) / 255)
    return SequenceFiles("film", tmp_path, tuple(names))


def test_spikes_and_ground_truth_are_those_of_the_version(film):
    """Sums of halves and quarters, which are exact on every machine."""
    recipe = ClipRecipe(scale=2, alpha=0.5, clocks=16, flow_times=(), interpolation=Blend(), seed=3)
    clip = recipe.clip(film, 2)
    found = hashlib.sha256(clip["spikes"].numpy().tobytes() + (clip["rgb"] * 255).round().byte().numpy().tobytes())
    assert found.hexdigest() == EXPECTED["clip"], CHANGED


def test_noise_is_that_of_the_version(film):
    """Number of changed bits; single bits depend on the logarithm of the machine."""
    noise = SensorNoise(photons=100, dark_current=0.01)
    plain, noisy = (
        ClipRecipe(scale=2, clocks=16, flow_times=(), interpolation=Blend(), **with_noise).clip(film, 2)["spikes"]
        for with_noise in ({}, {"noise": noise})
    )
    assert (plain != noisy).sum().item() == pytest.approx(EXPECTED["noise"], rel=5e-3), CHANGED


def test_latent_frames_and_flow_are_those_of_the_version():
    """At some pixels and approximately, as rounding decides when optical flow stops."""
    y, x = np.mgrid[:48, :64]
    waves = [np.sin((x - 3 * n) / 5 + k) * np.cos(y / 4 - k) for n in range(3) for k in range(3)]
    frames = torch.from_numpy(np.stack(waves).reshape(3, 3, 48, 64)).float() * 0.4 + 0.5
    seen = FrameSequence(frames, scale=2)
    for name, planes, near in (("light", seen.light(13, 1), 3e-4), ("flow", seen.clip(1, 21).flow(2), 3e-3)):
        found = planes[:, 5::8, 6::10].flatten().tolist()
        assert found == pytest.approx(EXPECTED[name], abs=near), CHANGED

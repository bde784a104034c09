"""Pictures of grey recordings, with networks for grey and for colour sensors."""

from __future__ import annotations

import pytest
import torch

from lightning_modules import reconstruct
from lightning_modules.inference.predict import predict
from lightning_modules.networks import CSCSR, RecurrentCSCSR
from spikekit import write_spikes

TINY = {"width": 8, "representation_width": 8, "features": 2, "stages": 1, "end_blocks": 1, "skip": True}


def _network(kind=CSCSR, scale=1, pattern="grey"):
    torch.manual_seed(0)
    network = kind(scale=scale, pattern=pattern, neighbors=1 if scale == 1 else 4, **TINY).eval()
    torch.nn.init.normal_(network.reconstruction.rgb.weight, std=0.05)
    return network


def _spikes(*size):
    return (torch.rand(size, generator=torch.Generator().manual_seed(0)) < 0.3).to(torch.uint8)


@pytest.mark.parametrize("scale", [1, 2])
@torch.inference_mode()
def test_tiles_and_self_ensemble_of_a_grey_clip(scale):
    network, spikes = _network(scale=scale), _spikes(1, 41, 61, 70)
    whole = predict(network, spikes, static=True, tile=0)
    assert whole.shape == (1, 1, 61 * scale, 70 * scale)
    torch.testing.assert_close(predict(network, spikes, static=True, tile=48), whole)
    views = [predict(network, one, static=True, self_ensemble=8) for one in (spikes, spikes.mT, spikes.flip(-1))]
    torch.testing.assert_close(views[1].mT, views[0])
    torch.testing.assert_close(views[2].flip(-1), views[0])  # odd sides as well: no phase is to be kept


@pytest.fixture
def recording(tmp_path):
    write_spikes(tmp_path / "clip.dat", _spikes(81, 16, 24))
    return {"path": tmp_path / "clip.dat", "height": 16, "width": 24}


@pytest.mark.parametrize(("kind", "pattern"), [(CSCSR, "grey"), (RecurrentCSCSR, "grey"), (CSCSR, "RGGB")])
def test_pictures_of_a_grey_recording(recording, kind, pattern):
    made = reconstruct(**recording, network=_network(kind, pattern=pattern), pattern="grey")
    pictures = made.array()
    assert pictures.shape == (3, 16, 24, 3)
    assert (pictures[..., :1] == pictures).all()
    assert len(made.notes) == (pattern != "grey")


def test_weights_for_another_sensor_give_a_note(recording):
    (note,) = reconstruct(**recording, network=_network(pattern="RGGB"), pattern="grey").notes
    assert "grey" in note
    assert "RGGB" in note
    (note,) = reconstruct(**recording, network=_network(), pattern="BGGR").notes
    assert "BGGR" in note
    assert not reconstruct(**recording, network=_network()).notes  # nobody says what the camera is


@pytest.mark.parametrize(("pattern", "weights"), [("grey", "cscsr_large_grey_x1"), ("RGGB", "cscsr_small_x1")])
def test_scale_1_has_weights_for_grey_and_colour(recording, pattern, weights):
    made = reconstruct(**recording, speed="best", scale=1, pattern=pattern)
    assert made.array().shape == (3, 16, 24, 3)
    assert made.notes[0].startswith(weights)


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_fastest_pictures_of_a_grey_recording_are_grey(recording, scale):
    made = reconstruct(**recording, speed="fastest", scale=scale, pattern="grey")
    assert made.network.pattern == "grey"  # for a Bayer filter, detail would be lost
    assert made.array().shape == (3, 16 * scale, 24 * scale, 3)

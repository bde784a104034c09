"""What the baselines share, against plain loops."""

import pytest
import torch
import torch.nn.functional as F

from lightning_modules.motion import MotionEstimator, ZeroFlow
from lightning_modules.networks.baselines.pictures import Baseline, decode_pictures, mirror_to_multiple
from spikekit import bayer_mask, tfi, tfp

SPIKES = (torch.rand(2, 41, 5, 6, generator=torch.Generator().manual_seed(0)) < 0.3).to(torch.uint8)


class Halves(MotionEstimator):
    def forward(self, spikes, times, pattern):
        assert (times, pattern) == ((5, 20, 35), "RGGB")
        flow = torch.full((len(spikes), 2, *spikes.shape[-2:]), 0.5)
        return -flow, flow


def baseline(motion=None, **changed):
    return Baseline(
        **{"scale": 2, "frames": 41, "pattern": "RGGB", "alpha": 0.4, "more": {}, "motion": motion} | changed
    )


@pytest.mark.parametrize(("decoder", "whole"), [("tfi", tfi), ("tfp", lambda spikes: tfp(spikes, 13))])
def test_pictures_are_those_of_the_stream(decoder, whole):
    light = SPIKES.float().requires_grad_()
    pictures = decode_pictures(light, (5, 20, 38), 0.5, decoder, 13)
    assert not pictures.requires_grad
    torch.testing.assert_close(pictures, 2 * whole(SPIKES)[:, [5, 20, 38]])


@pytest.mark.parametrize("size", [(7, 12), (8, 16), (3, 5), (2, 2)])
def test_mirrored_sides_keep_the_bayer_phase(size):
    planes, mask = torch.rand(2, *size), bayer_mask(*size, "GRBG")
    mirrored = mirror_to_multiple(planes, 8)
    height, width = mirrored.shape[-2:]
    assert (height % 8, width % 8) == (0, 0)
    assert max(height - size[0], width - size[1]) < 8
    assert mirrored[..., : size[0], : size[1]].equal(planes)
    assert mirror_to_multiple(mask, 8).equal(bayer_mask(height, width, "GRBG"))


def test_mirrored_sides_are_those_of_torch():
    planes = torch.rand(1, 2, 9, 11)
    assert mirror_to_multiple(planes, 8).equal(F.pad(planes, (0, 5, 0, 7), "reflect"))


def test_flow_is_that_which_is_given_or_estimated():
    given = torch.rand(2, 2, 2, 5, 6)
    assert baseline(Halves()).flow_or_estimate(SPIKES, given) is given
    assert baseline(Halves()).flow_or_estimate(SPIKES, None)[:, :, 0, 0, 0].tolist() == [[-0.5, 0.5]] * 2
    assert not baseline(Halves()).flow_or_estimate(SPIKES, None, static=True).any()
    assert not baseline(ZeroFlow()).flow_or_estimate(SPIKES, None).any()


@pytest.mark.parametrize("flow", [torch.zeros(2, 3, 2, 2, 5, 6), torch.zeros(2, 2, 5, 6), 0, "still"])
def test_another_flow_is_refused(flow):
    with pytest.raises(ValueError, match=r"^flow: expected \(2, 2, 2, 5, 6\), got "):
        baseline().flow_or_estimate(SPIKES, flow)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"frames": 40}, "frames: expected an odd number, 9 or more, got 40"),
        ({"scale": 0}, "scale: expected a whole number >= 1, got 0"),
        ({"alpha": 0.0}, "alpha: expected a finite number above 0, got 0.0"),
        ({"pattern": "RGB"}, "pattern: expected one of"),
    ],
)
def test_wrong_settings(changed, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        baseline(**changed)


@pytest.mark.parametrize("size", [(21, 5, 6), (41, 2, 6)])
def test_another_clip_is_refused(size):
    with pytest.raises(ValueError, match=r"^spikes: expected \(B, 41, H, W\) of at least 3 x 3 pixels, got"):
        baseline().check_spikes(torch.zeros(1, *size))

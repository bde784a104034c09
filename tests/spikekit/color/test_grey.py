"""Grey sensors, ``pattern="grey"``, in all operators with a pattern."""

from __future__ import annotations

import pytest
import torch
from kornia.color import rgb_to_grayscale

import spikekit as sk

FLOAT = torch.float64


@pytest.mark.parametrize("scale", [1, 3])
def test_mask_of_a_grey_sensor(scale):
    assert torch.equal(sk.bayer_mask(5, 4, "grey", scale=scale), torch.ones(1, 5 * scale, 4 * scale))
    assert sk.BayerMask("grey", scale=scale)(torch.zeros(2, 5, 4)).shape == (1, 5 * scale, 4 * scale)


@pytest.mark.parametrize("scale", [1, 2, 3])
def test_a_grey_sensor_sees_the_mean_luminance_of_a_block(scale):
    rgb = torch.rand(2, 3, 5 * scale, 7 * scale, dtype=FLOAT)
    luminance = 0.299 * rgb[:, 0] + 0.587 * rgb[:, 1] + 0.114 * rgb[:, 2]
    blocks = luminance.reshape(2, 5, scale, 7, scale).mean(dim=(2, 4))
    torch.testing.assert_close(sk.bin_to_sensor(rgb, "grey", scale=scale), blocks)
    torch.testing.assert_close(sk.bin_to_sensor(luminance[:, None], "grey", scale=scale), blocks)
    torch.testing.assert_close(sk.mosaic(rgb, "grey"), rgb_to_grayscale(rgb)[:, 0])


def test_a_grey_picture_is_copied_in_any_type():
    grey = torch.arange(12, dtype=torch.uint8).reshape(1, 3, 4)
    assert torch.equal(sk.mosaic(grey, "grey"), grey[0])
    half = torch.rand(3, 4, 4, dtype=torch.bfloat16)
    assert sk.mosaic(half, "grey").dtype == torch.bfloat16
    with pytest.raises(TypeError, match="floating-point"):
        sk.mosaic(torch.zeros(3, 4, 4, dtype=torch.uint8), "grey")


def test_grey_is_neither_split_nor_demosaiced():
    raw = torch.rand(2, 5, 7)
    assert torch.equal(sk.split_colors(raw, "grey"), raw[None])
    assert torch.equal(sk.demosaic(raw, "grey"), raw[:, None])
    assert torch.equal(sk.demosaic_residual(raw, "grey"), raw[:, None])
    for module in (sk.SplitColors("grey"), sk.Demosaic("grey"), sk.Mosaic("GREY"), sk.BinToSensor("grey", scale=2)):
        assert module.pattern == "grey"


@pytest.mark.parametrize("operator", [sk.split_bayer, sk.bayer_sites, sk.bayer_pattern])
def test_grey_is_rejected_if_a_bayer_cell_is_required(operator):
    given = [torch.zeros(2, 2)] if operator is sk.split_bayer else []
    with pytest.raises(ValueError, match=r"pattern: expected one of RGGB.*got 'grey'"):
        operator(*given, "grey")

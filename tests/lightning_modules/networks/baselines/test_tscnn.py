"""TSCNN: its parameters, what it starts from, and its parts against plain loops."""

import pytest
import torch

from lightning_modules.networks import TSCNN
from lightning_modules.networks.baselines.tscnn import KnownPixels
from spikekit import bayer_mask, demosaic_residual, tfi, tfp

TINY = {"width": 8, "blocks": 2, "low": 1, "high": 2}


def clip(batch=1, height=12, width=16):
    return (torch.rand(batch, 41, height, width, generator=torch.Generator().manual_seed(0)) < 0.3).to(torch.uint8)


@pytest.mark.parametrize(
    ("larger", "parameters"),
    [
        ({}, {2: 1_424_903, 3: 1_433_558, 4: 1_445_675}),
        ({"blocks": 4, "low": 4, "high": 6}, {2: 3_388_303, 3: 3_396_958, 4: 3_409_075}),
    ],
)
def test_parameters_are_those_of_the_publication(larger, parameters):
    for scale, expected in parameters.items():
        with torch.device("meta"):
            built = TSCNN(scale=scale, **larger)
        assert sum(p.numel() for p in built.parameters()) == expected


@pytest.mark.parametrize("size", [(9, 5), (3, 3), (8, 6)])
@pytest.mark.parametrize("scale", [1, 2, 3, 4])
def test_any_size_and_scale(scale, size):
    rgb = TSCNN(scale=scale, **TINY, skip=True)(clip(2, *size))
    assert rgb.shape == (2, 3, scale * size[0], scale * size[1])
    assert rgb.isfinite().all()


def test_every_parameter_learns():
    resting = None
    for seed in range(4):  # the few channels of an attention may all be silent by chance
        torch.manual_seed(seed)
        network = TSCNN(scale=2, **TINY | {"width": 32})
        network(clip(2)).square().mean().backward()
        assert all(p.grad is not None for p in network.parameters())
        silent = {name for name, p in network.named_parameters() if not p.grad.any()}
        resting = silent if resting is None else resting & silent
    assert not resting


@pytest.mark.parametrize(
    ("settings", "raw"),
    [
        ({"decoder": "tfi"}, lambda spikes: tfi(spikes)),
        ({"decoder": "tfp"}, lambda spikes: tfp(spikes, 41)),
        ({"decoder": "tfp", "tfp_window": 13}, lambda spikes: tfp(spikes, 13)),
    ],
)
def test_starts_from_the_decoded_picture(settings, raw):
    spikes = clip(2)
    rgb = TSCNN(scale=1, alpha=0.5, pattern="GBRG", **TINY, **settings, skip=True)(spikes)
    torch.testing.assert_close(rgb, demosaic_residual(raw(spikes)[:, 20] / 0.5, "GBRG"), rtol=0, atol=1e-4)


def test_a_flow_changes_nothing():
    network = TSCNN(scale=2, **TINY).eval()
    spikes = clip()
    with torch.no_grad():
        assert network(spikes, torch.randn(1, 2, 2, 12, 16)).equal(network(spikes))
    assert not network.takes_flow
    assert network.halo is None


@torch.no_grad()
def test_known_pixels_are_averaged_by_how_many_there_are():
    torch.manual_seed(0)
    part = KnownPixels(3).double().eval()
    part.norm.weight.uniform_(0.5, 2)
    part.norm.bias.normal_()
    part.norm.running_mean.normal_()
    part.norm.running_var.uniform_(0.5, 2)
    raw, mask = torch.rand(1, 1, 5, 6, dtype=torch.float64), bayer_mask(5, 6, dtype=torch.float64)[0]
    features = torch.zeros(1, 3, 5, 6, dtype=torch.float64)
    for y in range(5):
        for x in range(6):
            near = [(b, a) for b in range(5) for a in range(6) if max(abs(b - y), abs(a - x)) <= 2 and mask[b, a]]
            for b, a in near:
                features[0, :, y, x] += part.partial.weight[:, 0, b - y + 2, a - x + 2] * raw[0, 0, b, a] / len(near)
    norm = part.norm
    scaled = (features - norm.running_mean[:, None, None]) / (norm.running_var + norm.eps).sqrt()[:, None, None]
    expected = part.conv((scaled * norm.weight[:, None, None] + norm.bias[:, None, None]).relu())
    torch.testing.assert_close(part(raw, mask), expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"decoder": "tfx"}, "decoder: expected 'tfi' or 'tfp', got 'tfx'"),
        ({"tfp_window": 40}, "tfp_window: expected an odd number, got 40"),
        ({"width": 12}, "width: expected a multiple of 8, got 12"),
        ({"low": 0}, "low: expected a whole number >= 1, got 0"),
        ({"frames": 7}, "frames: expected an odd number, 9 or more, got 7"),
    ],
)
def test_wrong_arguments(arguments, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        TSCNN(**{**TINY, **arguments})

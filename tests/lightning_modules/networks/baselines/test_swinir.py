"""SwinIR: its parameters, and window attention against loops over pixels."""

import pytest
import torch

from lightning_modules.networks import SwinIR
from lightning_modules.networks.baselines.swinir import AttentionLayer, _hidden
from spikekit import demosaic_along_motion, linear_motion, tfi

TINY = {"width": 12, "groups": 2, "layers": 2, "heads": 2}


def clip(batch=1, height=12, width=16):
    generator = torch.Generator().manual_seed(0)
    spikes = (torch.rand(batch, 41, height, width, generator=generator) < 0.3).to(torch.uint8)
    return spikes, torch.randn(batch, 2, 2, height, width, generator=generator)


@pytest.mark.parametrize(
    ("changed", "parameters"),
    [
        ({}, {2: 910_152, 3: 918_267, 4: 929_628}),
        ({"width": 180, "groups": 6, "upsampler": "steps"}, {2: 11_752_487, 3: 11_937_127, 4: 11_900_199}),
    ],
)
def test_parameters_are_those_of_the_publication(changed, parameters):
    for scale, expected in parameters.items():
        with torch.device("meta"):
            built = SwinIR(scale, **changed)
        assert sum(p.numel() for p in built.parameters()) == expected


@pytest.mark.parametrize("upsampler", ["direct", "steps"])
@pytest.mark.parametrize("scale", [1, 2, 3, 4])
def test_any_size_and_scale(scale, upsampler):
    spikes, flow = clip(2, 9, 5)
    rgb = SwinIR(scale, **TINY, upsampler=upsampler)(spikes, flow)
    assert rgb.shape == (2, 3, 9 * scale, 5 * scale)
    assert rgb.isfinite().all()


@pytest.mark.parametrize("upsampler", ["direct", "steps"])
def test_every_parameter_learns(upsampler):
    torch.manual_seed(0)
    network = SwinIR(2, **TINY, upsampler=upsampler, drop_path=0.0)
    network(*clip()).square().mean().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters())


def test_picture_is_that_of_five_mosaics_along_the_motion():
    spikes, flow = clip(2)
    times = [10, 15, 20, 25, 30]
    offsets = linear_motion(flow[:, 0], flow[:, 1], times, first=5, middle=20, last=35)
    picture = demosaic_along_motion(tfi(spikes)[:, times] / 0.5, offsets, "GRBG")
    with torch.no_grad():
        rgb = SwinIR(1, alpha=0.5, pattern="GRBG", **TINY, skip=True)(spikes, flow)  # starts at the picture
    torch.testing.assert_close(rgb, picture)


def brute_force(layer, tokens):
    """Attention of one shifted layer without norms, pixel by pixel, in float64."""
    height, width, channels = tokens.shape
    qkv = (tokens @ layer.qkv.weight.T + layer.qkv.bias).reshape(height, width, 3, layer.heads, -1)

    def window(y, x):  # two pixels see each other where the grid, moved by the shift, has no line between them
        return (y - layer.shift) // 8, (x - layer.shift) // 8

    out = torch.zeros(height, width, channels, dtype=tokens.dtype)
    for y in range(height):
        for x in range(width):
            seen = [(b, a) for b in range(height) for a in range(width) if window(b, a) == window(y, x)]
            for head in range(layer.heads):
                query = qkv[y, x, 0, head] / qkv.shape[-1] ** 0.5
                scores = torch.stack(
                    [query @ qkv[b, a, 1, head] + layer.bias[(y - b + 7) * 15 + x - a + 7, head] for b, a in seen]
                )
                values = torch.stack([qkv[b, a, 2, head] for b, a in seen])
                size = channels // layer.heads
                out[y, x, head * size : (head + 1) * size] = scores.softmax(0) @ values
    return out @ layer.project.weight.T + layer.project.bias


@torch.no_grad()
@pytest.mark.parametrize("shift", [0, 4])
def test_attention_against_loops(shift):
    torch.manual_seed(0)
    layer = AttentionLayer(4, 2, shift, 0.0).double()
    layer.bias.normal_()
    layer.qkv.weight.normal_()
    tokens = torch.randn(1, 16, 8, 4, dtype=torch.float64)
    got = layer._attend(tokens, _hidden(16, 8, tokens.device))
    torch.testing.assert_close(got[0], brute_force(layer, tokens[0]))


def test_depth_is_stochastic_in_training_alone():
    network = SwinIR(2, **TINY, drop_path=0.5)
    spikes, flow = clip(8)
    with torch.no_grad():
        pictures = [network(spikes, flow) for _ in range(2)]
        assert not pictures[0].equal(pictures[1])
        network.eval()
        assert network(spikes, flow).equal(network(spikes, flow))
        drops = [layer.drop for group in network.groups for layer in group.layers]
        assert drops == pytest.approx([0, 1 / 6, 1 / 3, 1 / 2])
        layer, change = network.groups[1].layers[1].train(), torch.ones(4000, 1, 1, 1)
        assert layer._drop(change).mean().item() == pytest.approx(1, abs=0.1)
        assert set(layer._drop(change).unique().tolist()) == {0, 2}


def test_bfloat16_keeps_the_picture_in_float32():
    network = SwinIR(2, **TINY).eval()
    spikes, flow = clip()
    with torch.no_grad():
        exact = network(spikes, flow)
        with torch.autocast("cpu", torch.bfloat16):
            half = network(spikes, flow)
    assert half.dtype == torch.float32
    assert 0 < (half - exact).abs().max() < 0.05 * exact.abs().max()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"heads": 5}, "heads: expected a divisor of width = 12, got 5"),
        ({"upsampler": "bicubic"}, "upsampler: expected 'direct' or 'steps', got 'bicubic'"),
        ({"upsampler": "steps", "scale": 6}, "scale: expected 1, 3 or a power of two with upsampler 'steps', got 6"),
        ({"drop_path": 1.0}, r"drop_path: expected a share in \[0, 1\), got 1.0"),
        ({"groups": 0}, "groups: expected a whole number >= 1, got 0"),
    ],
)
def test_wrong_arguments(arguments, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        SwinIR(**{**TINY, **arguments})

"""Parts of single baselines, against plain loops."""

import itertools
import math

import pytest
import torch
import torch.nn.functional as F

from lightning_modules.networks import BasicVSR, RealRawVSR, SpikeSRNetLike, VidarSR
from lightning_modules.networks.baselines.parts import DeformableConv2d, mirror_to_multiple, run_per_channel
from lightning_modules.networks.baselines.swinir import AttentionLayer, _hidden
from lightning_modules.networks.baselines.tscnn import KnownPixels
from spikekit import bayer_mask, bayer_sites, demosaic_along_motion, flow_warp, mosaic, tfi, tfp


def clip(batch=1, height=12, width=16):
    spikes = (torch.rand(batch, 41, height, width) < 0.3).to(torch.uint8)
    return spikes, torch.randn(batch, 2, 2, height, width)


def seen_by(module, of=0):
    """Record the inputs of a module."""
    seen = []
    module.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[of]))
    return seen


# shared


@pytest.mark.parametrize("size", [(7, 12), (9, 11), (8, 16), (3, 5), (2, 2)])
def test_padding_keeps_the_bayer_phase(size):
    planes = torch.rand(1, 2, *size)
    mirrored = mirror_to_multiple(planes, 8)
    height, width = mirrored.shape[-2:]
    assert (height, width) == tuple(-(-side // 8) * 8 for side in size)
    assert mirrored[..., : size[0], : size[1]].equal(planes)
    assert mirror_to_multiple(bayer_mask(*size, "GRBG"), 8).equal(bayer_mask(height, width, "GRBG"))
    if min(size) > 8:
        assert mirrored.equal(F.pad(planes, (0, width - size[1], 0, height - size[0]), "reflect"))


def at(plane, y, x):
    """Sample bilinearly, zero outside."""
    total = 0.0
    for row, column in itertools.product((math.floor(y), math.floor(y) + 1), (math.floor(x), math.floor(x) + 1)):
        if 0 <= row < plane.shape[0] and 0 <= column < plane.shape[1]:
            total += plane[row, column].item() * (1 - abs(y - row)) * (1 - abs(x - column))
    return total


def test_deformable_convolution_against_loops():
    part = DeformableConv2d(4, groups=2).double()
    torch.nn.init.normal_(part.where.weight, std=0.3)
    torch.nn.init.normal_(part.where.bias)
    features, guide = torch.randn(2, 1, 4, 3, 4, dtype=torch.float64)
    offsets, masks = part.where(guide)[0].split([36, 18])
    offsets, masks = offsets.unflatten(0, (2, 9, 2)), masks.unflatten(0, (2, 9)).sigmoid()
    expected = part.bias[:, None, None].repeat(1, 3, 4)
    for c, y, x, tap in itertools.product(range(4), range(3), range(4), range(9)):
        dy, dx = offsets[c // 2, tap, :, y, x].tolist()
        value = at(features[0, c], y + tap // 3 - 1 + dy, x + tap % 3 - 1 + dx)
        expected[:, y, x] += part.weight[:, c, tap // 3, tap % 3] * value * masks[c // 2, tap, y, x]
    torch.testing.assert_close(part(features, guide)[0], expected)


def test_untrained_deformable_convolution_is_exact_under_autocast():
    """bfloat16 would round integers above 256."""
    part, features = DeformableConv2d(8), torch.randn(1, 8, 3, 600)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        got = part(features, features)
    torch.testing.assert_close(got, F.conv2d(features, part.weight / 2, part.bias, padding=1))


def ramps(height, width, scale=1):
    """Three planes with different slopes per sensor pixel, at any scale."""
    y, x = ((torch.arange(scale * side, dtype=torch.float64) + 0.5) / scale - 0.5 for side in (height, width))
    slopes = torch.tensor([[0.3, 0.7], [-0.2, 0.5], [0.9, -0.4]], dtype=torch.float64)
    return slopes[:, 0, None, None] * y[:, None] + slopes[:, 1, None, None] * x + 5


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
@pytest.mark.parametrize(("scale", "size"), [(1, (16, 20)), (2, (15, 19)), (3, (16, 19))])
def test_separate_colours_are_aligned(scale, pattern, size):
    """Bilinear enlargement keeps linear slopes, except near the border."""

    def enlarge(planes, flows):
        assert planes.shape == (4, 1, (size[0] + 1) // 2, (size[1] + 1) // 2)
        return F.interpolate(planes, scale_factor=2 * scale, mode="bilinear", align_corners=False)

    raw = mosaic(ramps(*size)[None], pattern)[:, None]
    rgb = run_per_channel(enlarge, raw, torch.zeros(1, 2, 2, *size).double(), pattern, scale)
    assert rgb.shape == (1, 3, scale * size[0], scale * size[1])
    inner = (..., slice(4 * scale, -4 * scale), slice(4 * scale, -4 * scale))
    torch.testing.assert_close(rgb[0][inner], ramps(*size, scale)[inner])


def test_flow_of_sub_streams_is_in_their_pixels():
    spikes, flow = torch.rand(2, 41, 6, 8), torch.randn(2, 2, 2, 6, 8)
    seen = []

    def reconstruct(planes, flows):
        seen.extend([planes, flows])
        return planes[:, :1].repeat_interleave(4, -1).repeat_interleave(4, -2)

    run_per_channel(reconstruct, spikes, flow, "GRBG", 2)
    for n, (_, row, column) in enumerate(bayer_sites("GRBG")):
        for got, whole in zip(seen, (spikes, flow / 2), strict=True):
            assert torch.equal(got[2 * n : 2 * n + 2], whole[..., row::2, column::2])


# BasicVSR


def test_features_propagate_from_both_ends_to_the_middle():
    network, (spikes, flow) = BasicVSR(2, width=4, blocks=1).double(), clip()
    flow = flow.double()
    late, early = seen_by(network.backward_trunk), seen_by(network.forward_trunk)
    got = network(spikes, flow)
    pictures = [planes[:, :3] for planes in (*early[:5], *late[::-1])]
    moved = [(flow[:, 0] * (5 - n) if n < 5 else flow[:, 1] * (n - 5)) / 5 for n in range(11)]
    ends = []
    for trunk, times in ((network.backward_trunk, range(10, 4, -1)), (network.forward_trunk, range(6))):
        state = torch.zeros(1, 4, 12, 16, dtype=torch.float64)
        for n, time in enumerate(times):
            if n:
                state = flow_warp(state, moved[times[n - 1]] - moved[time])
            state = trunk(torch.cat([pictures[time], state], dim=1))
        ends.append(state)
    features = network.enlarge(network.merge(torch.cat(ends, dim=1)))
    enlarged = F.interpolate(pictures[5], scale_factor=2, mode="bilinear")
    torch.testing.assert_close(got, network.picture(features) + enlarged)


def test_pictures_are_demosaiced_along_motion():
    network, (spikes, flow) = BasicVSR(2, width=4, blocks=1, alpha=0.5), clip()
    seen = seen_by(network.backward_trunk)
    network(spikes, flow)
    for n, around in ((10, (8, 9, 10, 9, 8)), (9, (7, 8, 9, 10, 9)), (6, (4, 5, 6, 7, 8))):
        motion = [(flow[:, 0] * (5 - k) if k < 5 else flow[:, 1] * (k - 5)) / 5 for k in (*around, n)]
        offsets = torch.stack([offset - motion[-1] for offset in motion[:-1]], dim=1)
        raws = 2 * tfi(spikes)[:, [5 + 3 * k for k in around]]
        torch.testing.assert_close(seen[10 - n][:, :3], demosaic_along_motion(raws, offsets, "RGGB"))


# Real-RawVSR


def test_five_mosaics_are_aligned_to_the_middle():
    network = RealRawVSR(2, decoder="tfp", width=8, blocks=2, pattern="GRBG", alpha=0.5)
    for module in network.modules():
        if hasattr(module, "where"):
            torch.nn.init.normal_(module.where.weight, std=0.1)
    mosaics, guides = seen_by(network.raw_features), seen_by(network.align.cascade, of=1)
    spikes, _ = clip(2, 16, 24)
    network(spikes)
    raws = 2 * tfp(spikes, 41)[:, [10, 15, 20, 25, 30]]
    torch.testing.assert_close(mosaics[0][:, 0], raws.flatten(0, 1))
    torch.testing.assert_close(guides[0], 2 * F.interpolate(guides[1], scale_factor=2, mode="bilinear"))


# SpikeSR-Net


def test_spikes_are_filtered_with_kernels_per_pixel():
    network = SpikeSRNetLike(2, width=8, maps=3, corrections=1, alpha=0.5).double()
    spikes, _ = clip(2, 4, 6)
    windows, maps = seen_by(network.kernels), seen_by(network.represent)
    network(spikes)
    expected = torch.stack([spikes[:, begin : begin + 13] for begin in (0, 7, 14, 21, 28)], dim=1).double()
    assert windows[0].unflatten(0, (2, 5)).equal(expected)
    kernels = network.kernels(windows[0])
    for n, m, y, x in itertools.product((0, 6), range(3), range(4), range(6)):
        weights = kernels[n, 13 * m : 13 * m + 13, y, x].softmax(dim=0)
        value = (weights * windows[0][n, :, y, x]).sum() / 0.5
        color = 0 if (y % 2, x % 2) == (0, 0) else 2 if (y % 2, x % 2) == (1, 1) else 1
        got = maps[0][n].unflatten(0, (3, 3))[:, m, y, x]  # by colour
        torch.testing.assert_close(got, torch.eye(3, dtype=torch.float64)[color] * value)


# SwinIR


def attention(layer, tokens):
    """Attention of one layer without norms, pixel by pixel."""
    height, width, channels = tokens.shape
    qkv = (tokens @ layer.qkv.weight.T + layer.qkv.bias).reshape(height, width, 3, layer.heads, -1)
    pixels = list(itertools.product(range(height), range(width)))

    def window(y, x):  # index of the shifted window of a pixel
        return (y - layer.shift) // 8, (x - layer.shift) // 8

    out = torch.zeros(height, width, layer.heads, channels // layer.heads, dtype=tokens.dtype)
    for (y, x), head in itertools.product(pixels, range(layer.heads)):
        seen = [(b, a) for b, a in pixels if window(b, a) == window(y, x)]
        query = qkv[y, x, 0, head] / qkv.shape[-1] ** 0.5
        scores = [query @ qkv[b, a, 1, head] + layer.bias[(y - b + 7) * 15 + x - a + 7, head] for b, a in seen]
        out[y, x, head] = torch.stack(scores).softmax(0) @ torch.stack([qkv[b, a, 2, head] for b, a in seen])
    return out.flatten(2) @ layer.project.weight.T + layer.project.bias


@torch.no_grad()
@pytest.mark.parametrize("shift", [0, 4])
def test_window_attention_against_loops(shift):
    layer = AttentionLayer(4, 2, shift, 0.0).double()
    layer.bias.normal_()
    layer.qkv.weight.normal_()
    tokens = torch.randn(1, 8, 8, 4, dtype=torch.float64)
    torch.testing.assert_close(layer._attend(tokens, _hidden(8, 8, tokens.device))[0], attention(layer, tokens[0]))


# TSCNN


@torch.no_grad()
def test_convolution_is_normalised_by_the_number_of_known_pixels():
    part = KnownPixels(3).double().eval()
    raw, mask = torch.rand(1, 1, 5, 6, dtype=torch.float64), bayer_mask(5, 6, dtype=torch.float64)[0]
    features = torch.zeros(1, 3, 5, 6, dtype=torch.float64)
    for y, x in itertools.product(range(5), range(6)):
        near = [(b, a) for b in range(5) for a in range(6) if max(abs(b - y), abs(a - x)) <= 2 and mask[b, a]]
        for b, a in near:
            features[0, :, y, x] += part.partial.weight[:, 0, b - y + 2, a - x + 2] * raw[0, 0, b, a] / len(near)
    torch.testing.assert_close(part(raw, mask), part.conv(part.norm(features).relu()))


# VidarSR


def test_neighbours_and_their_flows():
    network, (spikes, flow) = VidarSR(2, width=6, features=3), clip()
    assert network.times == (20, 6, 13, 27, 34)
    assert network.flow_times == (5, 20, 35)
    pairs = seen_by(network.encode_pair)
    network(spikes, flow)
    for pair, time in zip(pairs, network.times[1:], strict=True):
        expected = flow[:, 0] * (20 - time) / 15 if time < 20 else flow[:, 1] * (time - 20) / 15
        torch.testing.assert_close(pair[:, -2:], expected)

import pytest
import torch
import torch.nn.functional as F
from torch.utils.flop_counter import FlopCounterMode

from lightning_modules.networks import RealRawVSR
from lightning_modules.networks.baselines.real_rawvsr import _Fusion, _SelectiveKernel, _TemporalAttention
from spikekit import split_bayer, tfi, tfp

TINY = {"width": 8, "blocks": 2}


def clip(batch=1, height=12, width=16, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(batch, 41, height, width, generator=generator) < 0.3).to(torch.uint8)


def awake(network):
    """What starts at zero does not stay there."""
    for module in network.modules():
        if hasattr(module, "where"):
            torch.nn.init.normal_(module.where.weight, std=0.1)
        if hasattr(module, "gamma"):
            torch.nn.init.ones_(module.gamma)
    return network


@pytest.mark.parametrize(("scale", "count", "mmac"), [(2, 4_476_509, 7.86), (3, 4_678_459, 8.26), (4, 4_773_853, 9.11)])
def test_parameters_and_work_are_those_of_the_publication(scale, count, mmac):
    network = RealRawVSR(scale=scale)
    assert sum(p.numel() for p in network.parameters()) == count
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        network(clip(1, 16, 16))
    assert counter.get_total_flops() / 2 / 256 / 1e6 == pytest.approx(mmac, rel=0.01)


@pytest.mark.parametrize("scale", [2, 3, 4])
def test_any_size_and_scale(scale):
    torch.manual_seed(0)
    network = awake(RealRawVSR(scale=scale, **TINY))
    for size in ((9, 7), (4, 6)):
        rgb = network(clip(2, *size))
        assert rgb.shape == (2, 3, scale * size[0], scale * size[1])
        rgb.square().mean().backward()
        assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters())


@pytest.mark.parametrize(
    ("settings", "decode"), [({}, tfi), ({"decoder": "tfp", "tfp_window": 13}, lambda spikes: tfp(spikes, 13))]
)
def test_branches_see_mosaics_of_five_times(settings, decode):
    network, seen = RealRawVSR(scale=2, **TINY, **settings, pattern="GRBG", alpha=0.5), []
    for part in (network.raw_features, network.packed_features):
        part.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    spikes = clip(1, 8, 16)
    network(spikes)
    raws = 2 * decode(spikes)[0, [10, 15, 20, 25, 30]]
    torch.testing.assert_close(seen[0][:, 0], raws)
    torch.testing.assert_close(seen[1], split_bayer(raws, "GRBG").movedim(0, 1))


def test_offsets_of_the_mosaic_are_twice_those_of_the_packed_branch():
    """A guide found at half the size says at the full size that it is twice as far."""
    torch.manual_seed(0)
    network, guides = awake(RealRawVSR(scale=2, **TINY)), []
    network.align.cascade.register_forward_pre_hook(lambda _, inputs: guides.append(inputs[1]))
    network(clip(1, 8, 16))
    raw, packed = guides
    assert len(raw) == len(packed) == 5
    torch.testing.assert_close(raw, 2 * F.interpolate(packed, scale_factor=2, mode="bilinear"))


def test_every_time_of_every_clip_is_aligned_to_the_middle_of_its_clip():
    torch.manual_seed(0)
    network = awake(RealRawVSR(scale=2, **TINY))
    raws, packed = torch.rand(2, 5, 1, 16, 24), torch.rand(2, 5, 4, 8, 12)
    found = network._align(raws, packed)
    for clip in range(2):
        middle = network.packed_features(packed[clip, 2:3])
        for time in range(5):
            one = (
                network.raw_features(raws[clip, time : time + 1]),
                network.packed_features(packed[clip, time : time + 1]),
            )
            for branch, expected in zip(found, network.align(*one, middle), strict=True):
                torch.testing.assert_close(branch[clip, time], expected[0])


def test_attention_over_time():
    maps = torch.randn(2, 3, 4, 5, 6, dtype=torch.float64)
    part = _TemporalAttention().double()
    assert part(maps).equal(maps)
    torch.nn.init.constant_(part.gamma, 0.5)
    rows = maps.flatten(2)
    weights = (torch.einsum("bic,bjc->bij", rows, rows) / 120**0.5).exp()
    weights = weights / weights.sum(dim=2, keepdim=True)
    expected = maps + 0.5 * torch.einsum("bij,bjc->bic", weights, rows).reshape(maps.shape)
    torch.testing.assert_close(part(maps), expected)


def test_fusion_counts_maps_by_their_likeness_to_the_middle():
    torch.manual_seed(0)
    part, maps = _Fusion(3, 4).double(), torch.randn(1, 3, 4, 8, 8, dtype=torch.float64)
    seen = []
    part.merge.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    assert part(maps, 1).shape == (1, 4, 8, 8)
    for n in range(3):
        likeness = (part.each(maps[:, n]) * part.middle(maps[:, 1])).sum(dim=1, keepdim=True)
        torch.testing.assert_close(seen[0][:, 4 * n : 4 * n + 4], maps[:, n] / (1 + (-likeness).exp()))


def test_selective_kernel_is_a_mean_of_the_branches_channel_by_channel():
    torch.manual_seed(0)
    part = _SelectiveKernel(4).double()
    one, other = torch.randn(2, 2, 4, 5, 6, dtype=torch.float64)
    assert torch.allclose(part(one, one), one)
    share = (part(one, other) - other) / (one - other)
    assert share.min() > 0
    assert share.max() < 1
    torch.testing.assert_close(share, share.mean(dim=(-2, -1), keepdim=True).expand_as(share))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"decoder": "tfx"}, "decoder: expected 'tfi' or 'tfp', got 'tfx'"),
        ({"tfp_window": 12}, "tfp_window: expected an odd number, got 12"),
        ({"frames": 7}, "frames: expected an odd number, 9 or more, got 7"),
        ({"width": 12}, "width: expected a multiple of 8"),
    ],
)
def test_wrong_settings(settings, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        RealRawVSR(**settings)

import pytest
import torch

from lightning_modules.networks import BasicVSR
from spikekit import demosaic_along_motion, demosaic_residual, flow_warp, tfi

TINY = {"width": 4, "blocks": 1}


def clip(batch=1, height=12, width=16, seed=0):
    generator = torch.Generator().manual_seed(seed)
    spikes = (torch.rand(batch, 41, height, width, generator=generator) < 0.3).to(torch.uint8)
    return spikes, torch.randn(batch, 2, 2, height, width, generator=generator)


# the publication's 6,291,311 and 4,075,631 at x4, and 3.34 million, without the 1,440,300 of SPyNet
@pytest.mark.parametrize(("blocks", "count"), [(30, 6_291_311), (15, 4_075_631), (10, 3_337_071)])
def test_parameters_are_those_of_the_publication(blocks, count):
    with torch.device("meta"):
        network = BasicVSR(4, blocks=blocks)
    assert sum(p.numel() for p in network.parameters()) == count - 1_440_300


@pytest.mark.parametrize("scale", [2, 3, 4])
def test_any_size_and_scale(scale):
    torch.manual_seed(0)
    network = BasicVSR(scale, **TINY, neighbors=1)
    for size in ((9, 7), (4, 6)):
        spikes, flow = clip(2, *size)
        rgb = network(spikes, flow)
        assert rgb.shape == (2, 3, scale * size[0], scale * size[1])
        rgb.square().mean().backward()
        assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters())


def test_features_go_from_both_ends_to_the_middle():
    torch.manual_seed(0)
    network = BasicVSR(2, **TINY, neighbors=0).double()
    spikes, flow = clip()
    raws = tfi(spikes.double()) / 0.4
    pictures = [demosaic_residual(raws[:, 5 + 3 * n]) for n in range(11)]
    flow = flow.double()
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
    enlarged = torch.nn.functional.interpolate(pictures[5], scale_factor=2, mode="bilinear")
    torch.testing.assert_close(network(spikes, flow), network.picture(features) + enlarged)


def test_every_picture_is_demosaiced_along_the_motion_to_its_neighbours():
    network = BasicVSR(2, **TINY, neighbors=2, alpha=0.5)
    spikes, flow = clip()
    seen = []
    network.backward_trunk.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0][:, :3]))
    network(spikes, flow)
    raws = 2 * tfi(spikes)
    for n, around in ((10, (8, 9, 10, 9, 8)), (9, (7, 8, 9, 10, 9)), (6, (4, 5, 6, 7, 8))):
        motion = [(flow[:, 0] * (5 - k) if k < 5 else flow[:, 1] * (k - 5)) / 5 for k in (*around, n)]
        offsets = torch.stack([offset - motion[-1] for offset in motion[:-1]], dim=1)
        expected = demosaic_along_motion(raws[:, [5 + 3 * k for k in around]], offsets, "RGGB")
        torch.testing.assert_close(seen[10 - n], expected)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"neighbors": 5}, "neighbors: expected 0 to 4, got 5"),
        ({"frames": 11}, "frames: expected at least 13, got 11"),
        ({"blocks": 0}, "blocks: expected a whole number >= 1, got 0"),
    ],
)
def test_wrong_settings(settings, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        BasicVSR(**settings)

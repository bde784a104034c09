import itertools

import pytest
import torch

from lightning_modules.networks import SpikeSRNetLike

TINY = {"width": 8, "maps": 3, "corrections": 2}


def clip(batch=1, height=12, width=16, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(batch, 41, height, width, generator=generator) < 0.3).to(torch.uint8)


def parameters(*args, **settings):
    with torch.device("meta"):
        return sum(p.numel() for p in SpikeSRNetLike(*args, **settings).parameters())


def test_parameters():
    """The grey network of the publication has 3.34 million at x4; the colours cost 20,738 of ours."""
    assert [parameters(scale) for scale in (2, 3, 4)] == [2_278_443, 2_889_067, 3_343_659]


@pytest.mark.parametrize("per_channel", [False, True])
@pytest.mark.parametrize("scale", [2, 3, 4])
def test_any_size_and_scale(scale, per_channel):
    torch.manual_seed(0)
    network = SpikeSRNetLike(scale, **TINY, per_channel=per_channel)
    torch.nn.init.normal_(network.align.where.weight, std=0.1)  # from zero, the first step alone moves what is before
    for size in ((9, 7), (4, 6)):
        rgb = network(clip(2, *size))
        assert rgb.shape == (2, 3, scale * size[0], scale * size[1])
        rgb.square().mean().backward()
        assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters())


def test_every_pixel_filters_its_spikes_by_kernels_of_its_own():
    torch.manual_seed(0)
    network = SpikeSRNetLike(2, **TINY, alpha=0.5).double()
    window = clip(2, 4, 6)[:, :13].double()
    seen = []
    network.represent.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    network._represent(window)
    kernels = network.kernels(window)
    for n, m, y, x in itertools.product(range(2), range(3), range(4), range(6)):
        weights = kernels[n, 13 * m : 13 * m + 13, y, x].exp()
        value = (weights * window[n, :, y, x]).sum() / weights.sum() / 0.5
        color = 0 if (y % 2, x % 2) == (0, 0) else 2 if (y % 2, x % 2) == (1, 1) else 1
        got = seen[0][n].unflatten(0, (3, 3))[:, m, y, x]  # by colour
        torch.testing.assert_close(got, torch.eye(3, dtype=torch.float64)[color] * value)


def test_windows_are_those_of_the_stream():
    network = SpikeSRNetLike(2, **TINY)
    spikes, seen = clip(2, 4, 6), []
    network.kernels.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    network(spikes)
    expected = torch.stack([spikes[:, begin : begin + 13] for begin in (0, 7, 14, 21, 28)], dim=1)
    assert seen[0].unflatten(0, (2, 5)).equal(expected.float())


@pytest.mark.parametrize("per_channel", [False, True])
def test_a_mosaic_moved_by_a_pixel_is_one_of_another_phase(per_channel):
    torch.manual_seed(0)
    settings = {"scale": 2, **TINY, "per_channel": per_channel}
    network = SpikeSRNetLike(**settings).double()
    moved, other = SpikeSRNetLike(**settings, pattern="GRBG").double(), SpikeSRNetLike(**settings).double()
    moved.load_state_dict(network.state_dict())
    other.load_state_dict(network.state_dict())
    spikes = clip(1, 40, 48)
    inner = (..., slice(32, -32), slice(32, -32))
    expected = network(spikes)[inner]
    rolled = spikes.roll(1, dims=-1)
    deviation = [(net(rolled).roll(-2, dims=-1)[inner] - expected).abs().max() for net in (moved, other)]
    assert deviation[0] < 1e-3 * deviation[1]


@pytest.mark.parametrize(("length", "every"), [(12, 7), (13, 8), (13, 28), (43, 1)])
def test_windows_that_do_not_fit_are_refused(length, every):
    with pytest.raises(ValueError, match=f"got {length} and {every} with 41 frames"):
        SpikeSRNetLike(length=length, every=every)

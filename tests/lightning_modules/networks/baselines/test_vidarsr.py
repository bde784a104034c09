import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from lightning_modules.networks import VidarSR

TINY = {"width": 6, "features": 3}


def clip(batch=1, height=12, width=16, seed=0):
    generator = torch.Generator().manual_seed(seed)
    spikes = (torch.rand(batch, 41, height, width, generator=generator) < 0.3).to(torch.uint8)
    return spikes, torch.randn(batch, 2, 2, height, width, generator=generator)


def parameters(*args, **settings):
    with torch.device("meta"):
        return sum(p.numel() for p in VidarSR(*args, **settings).parameters())


# 10.15, 11.38 and 12.79 million with one plane a picture; three planes are 9,216 weights more
@pytest.mark.parametrize(("scale", "count"), [(2, 10_161_896), (3, 11_386_600), (4, 12_799_720)])
def test_parameters_of_the_published_size(scale, count):
    assert parameters(scale, width=256, features=64) == count


def test_parameters_of_the_grey_network_in_the_literature():
    """12.79 million at x4: that of one colour at x2, whose sub-streams are enlarged by 4."""
    assert parameters(2, width=256, features=64, per_channel=True) == 12_785_894


def test_parameters_and_work_of_the_small_size():
    """19 million multiplications a pixel, less 1.6 million of features that nothing would be made of."""
    assert parameters(4) == pytest.approx(1.83e6, rel=0.01)
    spikes, flow = clip(1, 8, 8)
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        VidarSR(4)(spikes, flow)
    assert counter.get_total_flops() / 2 / 64 / 1e6 == pytest.approx(17.5, rel=0.005)


@pytest.mark.parametrize("per_channel", [False, True])
@pytest.mark.parametrize("scale", [2, 3, 4])
def test_any_size_and_scale(scale, per_channel):
    torch.manual_seed(0)
    network = VidarSR(scale, **TINY, per_channel=per_channel)
    for size in ((9, 7), (4, 6)):
        spikes, flow = clip(2, *size)
        rgb = network(spikes, flow)
        assert rgb.shape == (2, 3, scale * size[0], scale * size[1])
        rgb.square().mean().backward()
        assert all(p.grad is not None for p in network.parameters())
        assert all(p.grad.abs().sum() > 0 for p in network.parameters() if p.ndim > 1)  # slopes of PReLU may rest


def test_neighbours_are_those_of_the_publication():
    network = VidarSR(2, **TINY)
    assert network.times == (20, 6, 13, 27, 34)
    assert network.flow_times == (5, 20, 35)
    pairs = []
    network.encode_pair.register_forward_pre_hook(lambda _, inputs: pairs.append(inputs[0]))
    spikes, flow = clip()
    network(spikes, flow)
    for pair, time in zip(pairs, network.times[1:], strict=True):
        expected = flow[:, 0] * (20 - time) / 15 if time < 20 else flow[:, 1] * (time - 20) / 15
        torch.testing.assert_close(pair[:, -2:], expected)


@pytest.mark.parametrize("per_channel", [False, True])
def test_a_mosaic_moved_by_a_pixel_is_one_of_another_phase(per_channel):
    torch.manual_seed(0)
    settings = {"scale": 2, **TINY, "per_channel": per_channel}
    network = VidarSR(**settings).double()
    moved, other = VidarSR(**settings, pattern="GRBG").double(), VidarSR(**settings).double()
    moved.load_state_dict(network.state_dict())
    other.load_state_dict(network.state_dict())
    spikes, flow = clip(1, 40, 48)
    inner = (..., slice(32, -32), slice(32, -32))
    expected = network(spikes, flow.double())[inner]
    rolled = spikes.roll(1, dims=-1), flow.double().roll(1, dims=-1)
    deviation = [(net(*rolled).roll(-2, dims=-1)[inner] - expected).abs().max() for net in (moved, other)]
    assert deviation[0] < 1e-3 * deviation[1]


def test_wrong_settings():
    with pytest.raises(ValueError, match="frames: expected an odd number, 9 or more, got 5"):
        VidarSR(frames=5)
    with pytest.raises(ValueError, match="width: expected a whole number >= 1, got 0"):
        VidarSR(width=0)

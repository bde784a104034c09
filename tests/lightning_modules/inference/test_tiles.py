import pytest
import torch

from lightning_modules.inference.tiles import forward_in_tiles
from lightning_modules.motion import MotionEstimator
from lightning_modules.networks import CSCSR, ClassicalDecoder
from spikekit.scenes.analytic import Layer, Motion, Scene
from spikekit.sensor.simulate import simulate_spikes

TINY = {"width": 4, "representation_width": 4, "features": 2, "stages": 1, "blocks": 1, "end_blocks": 1}


class Counting(MotionEstimator):
    """Half a pixel everywhere; remembers the sizes it was asked for."""

    def __init__(self):
        super().__init__()
        self.sizes = []

    def forward(self, spikes, times, pattern):
        self.sizes.append(tuple(spikes.shape[-2:]))
        flow = torch.full((len(spikes), 2, *spikes.shape[-2:]), 0.5)
        return -flow, flow


def counted(**settings):
    """A network at the sensor's resolution that writes down the sizes it runs on."""
    network = CSCSR(1, **TINY, skip=True, motion=Counting(), **settings)
    with torch.no_grad():
        network.reconstruction.rgb.weight.normal_(std=0.02, generator=torch.Generator().manual_seed(0))
    calls = []
    network.register_forward_pre_hook(lambda _, args: calls.append(tuple(args[0].shape[-2:])))
    return network, calls


def noise(height, width, seed=0):
    return torch.rand(3, height, width, generator=torch.Generator().manual_seed(seed))


def clip(layers, height, width):
    light = Scene(layers, 2 * height, 2 * width).light("RGGB", scale=2, alpha=0.4)
    return simulate_spikes(light, generator=torch.Generator().manual_seed(0))[None]


def coarse(height, width):
    """Texture that the sensor sees."""
    return noise(height, width).repeat_interleave(2, 1).repeat_interleave(2, 2)


def mixed():
    """An object that moves over a still, rich ground, in the second of three tiles of 64 sensor pixels."""
    thing = Layer(noise(48, 48, 1), Motion(velocity=(0.8, 0.0)), (176, 40), torch.ones(48, 48))
    return clip([Layer(coarse(64, 192)), thing], 64, 192)


def test_tiles_equal_manual_crops():
    network = CSCSR(1, **TINY, motion=Counting())
    spikes = mixed()
    flow, expected = network.estimate_flow(spikes), torch.empty(1, 3, 64, 192)
    with torch.no_grad():
        for left in (0, 64, 128):
            x = max(left - CSCSR.halo - 2, 0)  # it moves by half a pixel, and the Bayer phase is kept
            columns = slice(x, left + 64 + CSCSR.halo + 2)
            part = network(spikes[..., columns], flow[..., columns])
            expected[..., left : left + 64] = part[..., left - x :][..., :64]
        whole = network(spikes)
    assert forward_in_tiles(network, spikes, 64).equal(expected)
    assert forward_in_tiles(network, spikes, 0).equal(whole)


@pytest.mark.parametrize("settings", [{}, {"neighbors": 3}, {"resolution": "sensor"}, {"pattern": "grey"}])
@pytest.mark.parametrize("size", [(9, 12), (32, 20)])
def test_static_equals_zero_flow(settings, size):
    network = CSCSR(3, **TINY, **settings)
    spikes = (torch.rand(2, 41, *size, generator=torch.Generator().manual_seed(0)) < 0.3).to(torch.uint8)
    with torch.no_grad():
        general, still = network(spikes, torch.zeros(2, 2, 2, *size)), network(spikes, static=True)
    torch.testing.assert_close(still, general, rtol=1e-5, atol=1e-5)  # sums in another order


@pytest.mark.parametrize("flow", [0, "still"])
def test_flow_must_be_a_tensor(flow):
    message = f"^flow: expected .*, got {flow!r}; for no motion, pass static=True$"
    spikes = torch.zeros(1, 41, 8, 8)
    for run in (CSCSR(2, **TINY), lambda spikes, flow: forward_in_tiles(CSCSR(2, **TINY), spikes, 4, flow=flow)):
        with pytest.raises(ValueError, match=message):
            run(spikes, flow)
    with pytest.raises(ValueError, match=r"^flow, static: expected a flow or static=True, got both$"):
        CSCSR(2, **TINY)(spikes, torch.zeros(1, 2, 2, 8, 8), static=True)


@pytest.mark.parametrize(("size", "tile"), [((3, 5), 128), ((17, 33), 16), ((50, 70), 50), ((40, 24), 0)])
def test_any_size_and_batch(size, tile):
    network, _ = counted(pattern="GBRG")
    spikes = (torch.rand(2, 41, *size, generator=torch.Generator().manual_seed(0)) < 0.3).to(torch.uint8)
    rgb = forward_in_tiles(network, spikes, tile)
    with torch.no_grad():
        expected = network(spikes)
    assert rgb.shape == expected.shape
    torch.testing.assert_close(rgb, expected, rtol=0, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("scale", [2, 3])
def test_decoder_depends_only_on_its_halo(scale):
    spikes = (torch.rand(1, 41, 40, 56, generator=torch.Generator().manual_seed(0)) < 0.4).to(torch.uint8)
    decoder = ClassicalDecoder("tfi", scale, "GBRG")
    torch.testing.assert_close(forward_in_tiles(decoder, spikes, 16), decoder(spikes), rtol=0, atol=1e-5)
    decoder.halo -= 2
    assert (forward_in_tiles(decoder, spikes, 16) - decoder(spikes)).abs().max() > 0.01


@torch.no_grad()
def test_network_without_halo_is_not_tiled():
    network, calls = counted()
    network.halo = None
    spikes = mixed()
    expected = network(spikes)
    calls.clear()
    assert forward_in_tiles(network, spikes, 64).equal(expected)
    assert calls == [(64, 192)]


@pytest.mark.parametrize("tile", [0, 64])
def test_given_flow_replaces_the_estimate(tile):
    network, _ = counted()
    spikes = mixed()
    flow = network.estimate_flow(spikes)
    expected = forward_in_tiles(network, spikes, tile)
    network.motion.sizes.clear()
    assert forward_in_tiles(network, spikes, tile, flow).equal(expected)
    assert not forward_in_tiles(network, spikes, tile, -flow).equal(expected)
    assert network.motion.sizes == []


def test_static_needs_no_estimate():
    network, _ = counted()
    spikes = mixed()
    still = forward_in_tiles(network, spikes, 64, static=True)
    zeros = forward_in_tiles(network, spikes, 64, torch.zeros(1, 2, 2, 64, 192))
    torch.testing.assert_close(still, zeros, rtol=0, atol=1e-5)
    assert network.motion.sizes == []


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_gpu_gives_the_same_picture():
    network, _ = counted()
    spikes = mixed()
    expected = forward_in_tiles(network, spikes, 64)
    rgb = forward_in_tiles(network.cuda(), spikes.cuda(), 64).cpu()
    torch.testing.assert_close(rgb, expected, rtol=0, atol=1e-3)

import pytest
import torch
from skimage import data
from torch.utils.flop_counter import FlopCounterMode

from lightning_modules.inference.tiles import forward_in_tiles
from lightning_modules.motion import ZeroFlow
from lightning_modules.networks import CSCSR, ClassicalDecoder
from lightning_modules.networks.layers import ConvBlock, res_blocks
from spikekit import bin_to_sensor, demosaic, mosaic, psnr, simulate_spikes, spike_integrate_fire, tfi, tfp

TINY = {"width": 4, "representation_width": 4, "features": 2, "stages": 2, "blocks": 1, "end_blocks": 1}


def clip(batch=1, height=12, width=16, seed=0):
    generator = torch.Generator().manual_seed(seed)
    spikes = (torch.rand(batch, 41, height, width, generator=generator) < 0.3).to(torch.uint8)
    return spikes, torch.randn(batch, 2, 2, height, width, generator=generator)


def test_trace_does_not_record_the_motion_of_its_example():
    spikes, flow = clip()
    network = CSCSR(2, **TINY)
    for inputs in ((spikes,), (spikes, flow)):
        with pytest.raises(RuntimeError, match=r"torch\.jit\.trace: expected static=True or ZeroFlow"):
            torch.jit.trace(network, inputs)
    at_rest, other = CSCSR(2, motion=ZeroFlow(), **TINY), clip(seed=1)[0]
    torch.testing.assert_close(torch.jit.trace(at_rest, (spikes,))(other), at_rest(other))


# the figures in sizes.py
@pytest.mark.parametrize(
    ("size", "parameters", "mmac"),
    [
        ("full_small", 165_801, 1.86),
        ("full_base", 726_447, 9.06),
        ("full_large", 2_832_251, 42.7),
        ("base", 1_320_742, 1.72),
        ("small", 1_080_294, 1.48),
        ("tiny", 300_963, 0.356),
        ("huge", 3_783_526, 4.18),
        ("micro", 655_360, 0.164),
        ("nano", 146_656, 0.0366),
    ],
)
def test_parameters_and_multiplications_of_each_size(size, parameters, mmac):
    network = CSCSR(4, size=size)
    assert network.times == (5, 8, 11, 14, 17, 20, 23, 26, 29, 32, 35)[:: 2 if size == "tiny" else 1]
    assert network.flow_times == (5, 20, 35)
    assert sum(p.numel() for p in network.parameters()) == parameters
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        network(torch.zeros(1, network.frames, 8, 8), torch.zeros(1, 2, 2, 8, 8))
    assert counter.get_total_flops() / 2 / 64 / 1e6 == pytest.approx(mmac, rel=0.005)


@pytest.mark.parametrize(
    ("scale", "size", "choice"),
    [
        (1, (12, 16), {}),
        (2, (3, 4), {}),
        (3, (9, 7), {}),
        (4, (9, 8), {}),
        (1, (9, 7), {"resolution": "sensor"}),
        (2, (9, 7), {"resolution": "sensor", "end_width": 6}),
        (2, (9, 7), {"resolution": "sensor", "reconstruction": "separate"}),
        (3, (9, 7), {"resolution": "sensor", "reconstruction": "early"}),
        (3, (9, 7), {"resolution": "sensor", "reconstruction": "early", "end_width": 6}),
        (1, (9, 7), {"resolution": "cell"}),
        (4, (9, 8), {"resolution": "cell", "pattern": "GBRG"}),
    ],
)
def test_any_size_and_scale_works_and_every_parameter_has_a_gradient(scale, size, choice):
    torch.manual_seed(0)  # other seeds may leave all of these few channels inactive
    network = CSCSR(scale, **TINY, **choice)
    spikes, flow = clip(2, *size)
    rgb = network(spikes, flow)
    assert rgb.shape == (2, 3, scale * size[0], scale * size[1])
    rgb.square().mean().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() and p.grad.any() for p in network.parameters())


@torch.no_grad()
@pytest.mark.parametrize(
    ("name", "expected"), [("micro_x4", 26.11), ("tiny_x4", 26.54), ("base_x3", 27.23), ("small_noisy_x4", 26.84)]
)
def test_weights_of_the_package_give_the_picture_that_they_were_trained_for(name, expected):
    network = CSCSR.from_pretrained(f"cscsr_{name}")
    side = 48 * network.scale
    rgb = torch.tensor(data.astronaut()).movedim(-1, 0)[:, :side, 150 : 150 + side] / 255
    raw = [bin_to_sensor(rgb.roll((n - 20) // 4, -1), scale=network.scale) for n in range(41)]
    spikes = simulate_spikes(0.4 * torch.stack(raw), generator=torch.Generator().manual_seed(0))
    assert psnr(network(spikes[None])[0].clamp(0, 1), rgb).item() == pytest.approx(expected, abs=0.02)


def test_network_is_equivariant_to_shifts_by_bayer_cells():
    network = CSCSR(2, **TINY).double()
    spikes, _ = clip(1, 48, 48)
    still = torch.zeros(1, 2, 2, 48, 48, dtype=torch.float64)
    moved = network(spikes.roll((2, 4), dims=(-2, -1)), still).roll((-4, -8), dims=(-2, -1))
    torch.testing.assert_close(moved[..., 32:-32, 32:-32], network(spikes, still)[..., 32:-32, 32:-32])


@torch.no_grad()
@pytest.mark.parametrize(("pattern", "row", "column"), [("GRBG", 0, 1), ("GBRG", 1, 0), ("BGGR", 1, 1)])
def test_cells_begin_with_red(pattern, row, column):
    """The network of one phase serves the others, also in tiles."""
    made = {"scale": 2, **TINY, "resolution": "cell"}
    network, other = CSCSR(**made), CSCSR(**made, pattern=pattern)
    spikes, _ = clip(1, 40, 40)
    other.load_state_dict(network.state_dict())
    cut = spikes[..., row:, column:]
    part, whole = other(cut), network(spikes)[..., 2 * row :, 2 * column :]
    torch.testing.assert_close(part[..., 20:-20, 20:-20], whole[..., 20:-20, 20:-20])
    torch.testing.assert_close(forward_in_tiles(other, cut, 16), part)
    for dtype in (torch.bool, torch.int64, torch.float64):
        torch.testing.assert_close(network(spikes.to(dtype)), network(spikes))


def test_skip_starts_from_a_smooth_classical_picture():
    """It equals the classical picture of flat scenes, and has no zipper artefacts at edges."""
    spikes = torch.ones(1, 41, 12, 12)
    torch.testing.assert_close(CSCSR(4, **TINY, skip=True)(spikes, clip(1, 12, 12)[1]), torch.full((1, 3, 48, 48), 2.5))
    spikes[..., 6:] = 0
    rgb = CSCSR(1, **TINY, skip=True)(spikes, clip(1, 12, 12)[1])
    zipper = (rgb[..., 1:-1, :] - (rgb[..., :-2, :] + rgb[..., 2:, :]) / 2)[..., 2:-2, :]
    raw = ClassicalDecoder("tfp", 1)(spikes)
    assert zipper.abs().max() < 0.1 * (raw[..., 1:-1, :] - (raw[..., :-2, :] + raw[..., 2:, :]) / 2).abs().max()


@pytest.mark.parametrize("motion", [1, 15, torch.nan])
def test_tiles_give_the_picture_of_the_whole(motion):
    """Tiles include the pixels that move into them, at any speed."""
    network = CSCSR(2, **TINY, skip=True)
    with torch.no_grad():
        network.reconstruction.rgb.weight.normal_(std=0.1)
    spikes, flow = clip(1, 70, 58)
    flow = flow * motion
    flow[..., 0, :32, :] += 9 * motion
    network.estimate_flow = lambda _: flow
    torch.testing.assert_close(forward_in_tiles(network, spikes, 32), network(spikes, flow), rtol=0, atol=1e-5)


@pytest.mark.parametrize(("method", "pattern", "alpha"), [("tfi", "RGGB", 0.5), ("tfp", "GBRG", 0.02)])
def test_classical_decoder_recovers_the_colour_of_a_flat_scene(method, pattern, alpha):
    """Also of a dark one, in which the interval between spikes exceeds the window of TFP."""
    rgb = torch.tensor([1.0, 0.5, 0.25]).reshape(1, 3, 1, 1)
    light = alpha * mosaic(rgb.expand(1, 3, 12, 12), pattern).expand(411, 1, 12, 12).movedim(0, 1)
    spikes, _ = spike_integrate_fire(light)
    decoded = ClassicalDecoder(method, 2, pattern, alpha)(spikes)
    assert psnr(decoded, rgb.expand_as(decoded)).item() > 30


@pytest.mark.parametrize(
    ("method", "settings"), [("tfi", {}), ("tfp", {"window": 13}), ("tfp", {"window": 13, "order": 3})]
)
def test_classical_decoder_decodes_the_middle_frame(method, settings):
    spikes, _ = clip(2)
    raw = {"tfi": tfi, "tfp": tfp}[method](spikes, **settings)[:, 20]
    torch.testing.assert_close(ClassicalDecoder(method, 1, **settings)(spikes), demosaic(raw / 0.4))


def test_classical_decoder_averages_longer_in_longer_clips():
    spikes = torch.rand(2, 41, 8, 8, generator=torch.Generator().manual_seed(0)) < 0.9
    rgb = ClassicalDecoder("tfp", 1, window=5, frames=5)(spikes)  # 5 (41 / 5)^(1/3) is 10.1
    torch.testing.assert_close(rgb, demosaic(tfp(spikes, window=11)[:, 20] / 0.4))


def test_invalid_shapes_are_rejected():
    spikes, flow = clip()
    network = CSCSR(2, **TINY)
    with pytest.raises(ValueError, match=r"expected \(B, 41, H, W\) of at least 3 x 3 pixels, got \(1, 21, 12, 16\)"):
        network(spikes[:, :21], flow)
    with pytest.raises(ValueError, match="flow: expected"):
        network(spikes, flow[..., :8])


def test_training_works_after_inference_mode():
    """Tensors cached in Lightning's validation are valid in training."""
    network = CSCSR(2, **TINY)
    spikes, flow = clip()
    with torch.inference_mode():
        seen = network(spikes, flow)
    learned = network(spikes, flow)
    learned.square().mean().backward()
    torch.testing.assert_close(learned, seen, rtol=0, atol=1e-5)


@pytest.mark.parametrize("half", [False, True])
def test_inference_gives_the_features_of_training(half):
    blocks, x = torch.nn.Sequential(ConvBlock(3, 8), *res_blocks(8, 2)), torch.randn(2, 3, 9, 7)
    with torch.autocast("cpu", torch.bfloat16, enabled=half):
        trained = blocks(x).detach()
        with torch.no_grad():
            torch.testing.assert_close(blocks(x), trained, rtol=0, atol=2e-2 if half else 1e-6)

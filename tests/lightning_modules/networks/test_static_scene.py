import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from lightning_modules.networks import CSCSR, cscsr
from lightning_modules.networks.static_scene import WORTH_IT, rest_response

TINY = {"stride": 10, "width": 4, "representation_width": 4, "features": 2, "stages": 1, "blocks": 1, "end_blocks": 1}
SIZES = (WORTH_IT, WORTH_IT), (WORTH_IT + 1, WORTH_IT + 2), (WORTH_IT + 4, WORTH_IT + 3)
PATTERNS = ["RGGB", "BGGR", "GRBG", "GBRG"]
SETTINGS = [{}, {"scale": 4, "refinement": False}, {"neighbors": 1}]


def tiny(scale=3, **settings):
    return CSCSR(scale, **TINY, resolution="sensor", **settings).double()


def clip(height, width, batch=1):
    return torch.rand(batch, 41, height, width, generator=torch.Generator().manual_seed(0)) < 0.3


@pytest.fixture(name="searched")
def _searched(monkeypatch):
    """Sizes of the pictures in which the network has searched."""
    sizes, warp = [], cscsr.flow_warp_idw
    monkeypatch.setattr(
        cscsr, "flow_warp_idw", lambda *args, **how: sizes.append(tuple(args[0].shape[-2:])) or warp(*args, **how)
    )
    return sizes


def both(network, spikes):
    """What a flow of 0 gives, and what flows of zeros give."""
    return network(spikes, static=True), network(spikes, torch.zeros(len(spikes), 2, 2, *spikes.shape[-2:]))


@torch.no_grad()
@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("settings", SETTINGS)
def test_search_and_convolution_are_one(pattern, settings, searched):
    """Any two of a pattern, settings and a size meet."""
    network = tiny(**settings, pattern=pattern)
    size = SIZES[(PATTERNS.index(pattern) + SETTINGS.index(settings)) % len(SIZES)]
    at_rest, expected = both(network, clip(*size, batch=2))
    torch.testing.assert_close(at_rest, expected, rtol=0, atol=1e-12)
    assert all(min(sides) < 16 * network.scale for sides in searched[:6])  # two opposite sides, of every colour


def test_gradients_are_those_of_a_search():
    network = tiny()
    losses = (rgb.square().mean() for rgb in both(network, clip(64, 66)))
    gradients = [torch.autograd.grad(loss, [*network.parameters()]) for loss in losses]
    for at_rest, searched in zip(*gradients, strict=True):
        torch.testing.assert_close(at_rest, searched, rtol=1e-9, atol=1e-12)


@torch.no_grad()
@pytest.mark.parametrize(
    ("settings", "side"),
    [({"scale": 2}, 64), ({"neighbors": 5}, 64), ({"representation": "spikes"}, 64), ({}, WORTH_IT - 2)],
)
def test_what_is_not_worth_it_is_searched(settings, side, searched):
    network = tiny(**settings)
    torch.testing.assert_close(*both(network, clip(side, side)), rtol=0, atol=1e-12)
    assert searched[:3] == [(network.scale * side, network.scale * side)] * 3


@torch.no_grad()
def test_it_is_less_work():
    network, flops = CSCSR.from_pretrained("cscsr_small_x4"), []
    for given in ({"static": True}, {"flow": torch.zeros(1, 2, 2, 128, 128)}):
        with FlopCounterMode(display=False) as counter:
            network(clip(128, 128), **given)
        flops.append(counter.get_total_flops())
    assert flops[0] < 0.85 * flops[1]


@torch.no_grad()
@pytest.mark.parametrize("how", ["mixed", "true"])
def test_half_precision_loses_no_more_than_with_a_search(how):
    network, spikes = CSCSR.from_pretrained("cscsr_tiny_x4"), clip(64, 64)
    exact = network(spikes, static=True)
    if how == "mixed":
        with torch.autocast("cpu", torch.bfloat16):
            pictures = both(network, spikes)
    else:
        pictures = both(network.bfloat16(), spikes)
    at_rest, searched = ((rgb.float() - exact).square().mean().sqrt() for rgb in pictures)
    assert 0 < at_rest < 1.1 * searched


def test_compiles_in_one_piece():
    network, spikes = tiny().eval(), clip(64, 64)
    with torch.inference_mode():
        expected = network(spikes, static=True)
    torch.testing.assert_close(torch.compile(network, fullgraph=True, backend="eager")(spikes, static=True), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_is_kept_in_inference_mode_serves_training(dtype):
    rest_response.cache_clear()
    with torch.inference_mode():
        tiny()
    network = tiny().to(dtype)
    with torch.inference_mode():
        network(clip(64, 64), static=True)
    network(clip(64, 64), static=True).mean().backward()
    assert all(p.grad is not None for p in network.parameters())


def test_built_where_tensors_are_elsewhere_by_default():
    rest_response.cache_clear()
    with torch.device("meta"):
        network = tiny()
    assert next(network.parameters()).is_meta
    network.to_empty(device="cpu").load_state_dict(tiny().state_dict())
    torch.testing.assert_close(*both(network, clip(64, 64)), rtol=0, atol=1e-12)

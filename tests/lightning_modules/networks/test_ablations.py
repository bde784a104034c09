"""The ten variants of Table 3, and what each omits or replaces."""

import pytest
import torch
import yaml

from lightning_modules.inference.tiles import forward_in_tiles
from lightning_modules.motion import MotionEstimator
from lightning_modules.networks import CSCSR, CSCSRConfig
from lightning_modules.tasks.super_resolution import SuperResolution
from spikekit import bayer_mask, bayer_sites, spike_interval

TINY = {"width": 4, "representation_width": 4, "features": 2, "stages": 2, "blocks": 1, "end_blocks": 1}


class Motions(MotionEstimator):
    """Known flows of the four sub-streams in Bayer cells; y is half of x."""

    def __init__(self, constants=(1.0, 1.0, 1.0, 1.0)):
        super().__init__()
        self.constants = torch.tensor(constants)
        self.direction = torch.nn.Parameter(torch.tensor([1.0, 0.5]))

    def channel_flows(self, spikes, times, pattern):
        height, width = spikes.shape[-2:]
        size = 4, len(spikes), 2, (height + 1) // 2, (width + 1) // 2
        constants = self.constants.reshape(4, 1, 1, 1, 1)
        to_last = (constants * self.direction.reshape(2, 1, 1).float()).expand(size)
        return -to_last, to_last


class Slopes(MotionEstimator):
    """Perfect estimates of a flow that is linear in space, sampled at the pixels of each sub-stream."""

    def channel_flows(self, spikes, times, pattern):
        height, width = spikes.shape[-2:]
        flow = slope((height + 1) // 2 * 2, (width + 1) // 2 * 2).expand(len(spikes), -1, -1, -1)
        sites = torch.stack([flow[..., row::2, column::2] / 2 for _, row, column in bayer_sites(pattern)])
        return -sites, sites


class Unwanted(MotionEstimator):
    def channel_flows(self, spikes, times, pattern):
        raise AssertionError("this variant needs no motion")

    forward = channel_flows


def slope(height, width):
    y, x = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    return torch.stack([0.5 + 0.25 * x - 0.1 * y, 0.3 * y - 1])


def settings(configs, *overlays):
    """Arguments of the network after all overlays."""
    merged = {}
    for overlay in overlays:
        config = yaml.safe_load((configs / f"{overlay}.yaml").read_text())
        merged.update(config["model"]["network"]["init_args"])
    return merged


def variant(letter, configs, scale=2, seed=0, **arguments):
    torch.manual_seed(seed)
    return CSCSR(**{**TINY, "scale": scale, **settings(configs, f"ablation/{letter}"), **arguments})


def clip(batch=1, height=12, width=16, seed=0):
    generator = torch.Generator().manual_seed(seed)
    spikes = (torch.rand(batch, 41, height, width, generator=generator) < 0.3).to(torch.uint8)
    return spikes, torch.randn(batch, 2, 2, height, width, generator=generator)


def test_variant_j_is_the_default_and_variant_d_estimates_motion(configs):
    plain, full = (CSCSRConfig(**settings(configs, "x4", "quick", *over)) for over in ((), ("ablation/j",)))
    assert plain == full
    assert yaml.safe_load((configs / "ablation/d.yaml").read_text())["model"]["flow"] == "estimated"


@pytest.mark.parametrize("letter", "abcdefghij")
def test_any_size_works_and_every_parameter_has_a_gradient(letter, configs):
    spikes, flow = clip(2, 9, 7)
    network = variant(letter, configs, 3, motion=Motions())
    rgb = network(spikes)
    assert rgb.shape == (2, 3, 27, 21)
    assert rgb.isfinite().all()
    rgb.square().mean().backward()
    for name, parameter in network.named_parameters():
        if name != "motion.direction" or letter != "f":
            assert parameter.grad is not None, name
            assert parameter.grad.abs().sum() > 0, name
    assert network(spikes[:, :, :3, :3], flow[..., :3, :3]).shape == (2, 3, 9, 9)


@pytest.mark.parametrize("letter", "ceh")
def test_float64_and_bfloat16_agree_with_float32(letter, configs):
    spikes, _ = clip(1, 12, 12)
    network = variant(letter, configs, motion=Motions((0.93, 0.41, 0.57, 0.13)), skip=True)
    torch.nn.init.normal_(network.reconstruction.rgb.weight, std=0.1)
    with torch.no_grad():
        exact = network(spikes)
        with torch.autocast("cpu", torch.bfloat16):
            half = network(spikes)
        double = network.double()(spikes)
    assert (half.dtype, double.dtype) == (torch.float32, torch.float64)
    assert not half.bfloat16().float().equal(half)
    assert (half - exact).abs().max() < 0.05 * exact.abs().max()
    torch.testing.assert_close(double.float(), exact, rtol=0, atol=1e-4)


# A, B, C: representation


@pytest.mark.parametrize("letter", "ac")
def test_a_gives_the_firing_rate_and_c_the_inverse_interval(letter, configs):
    spikes, _ = clip()
    spikes[..., 2, 2] = 0
    mask = bayer_mask(12, 16)[0]
    seen = variant(letter, configs).representation[0](spikes * mask)
    if letter == "a":
        expected = torch.stack([spikes[:, time - 5 : time + 6].sum(1) / 11 for time in range(5, 36, 3)], dim=1) * mask
    else:
        expected = mask / spike_interval(spikes)[:, 5:36:3]
        expected[..., 2, 2] = 0
    torch.testing.assert_close(seen[:, :, 0], expected)


@pytest.mark.parametrize(("letter", "sees"), [("a", False), ("b", False), ("j", True)])
def test_only_global_perception_sees_frames_between_windows(letter, sees, configs):
    network = variant(letter, configs, window=5, stride=12)  # frames 0-4, 12-16, 24-28, 36-40
    spikes, flow = clip()
    spikes[:, 8] = 0
    before = network(spikes, 0 * flow)
    spikes[:, 8] = 1
    assert before.equal(network(spikes, 0 * flow)) != sees
    spikes[:, 14] = 1 - spikes[:, 14]
    assert not before.equal(network(spikes, 0 * flow))


# D, E: motion


@pytest.mark.parametrize("letter", "de")
def test_d_and_e_equal_j_if_all_colours_move_alike(letter, configs):
    spikes, flow = clip(2, 13, 11)
    one, other = variant(letter, configs, motion=Motions()), variant("j", configs, motion=Motions())
    torch.testing.assert_close(one(spikes), other(spikes))
    assert one(spikes, flow).equal(other(spikes, flow))  # a given flow applies to all colours


@pytest.mark.parametrize(("letter", "pattern"), [("d", "RGGB"), ("d", "GBRG"), ("e", "RGGB"), ("e", "GBRG")])
def test_flows_are_aligned_with_their_pixels(letter, pattern, configs):
    spikes, _ = clip(2, 13, 10)
    flow = variant(letter, configs, pattern=pattern, motion=Slopes()).estimate_flow(spikes)
    flow = flow if letter == "d" else flow[:, None]
    assert flow.shape == (2, 3 if letter == "d" else 1, 2, 2, 13, 10)
    expected = slope(13, 10).expand_as(flow[:, :, 0])
    inside = (..., slice(1, -1), slice(1, -1))
    torch.testing.assert_close(flow[:, :, 0][inside], -expected[inside])
    torch.testing.assert_close(flow[:, :, 1][inside], expected[inside])


def test_tiles_use_the_flow_of_each_colour(configs):
    network = variant("d", configs, motion=Motions((0.2, 0.4, 0.1, 0.3)))
    spikes, _ = clip(1, 70, 58)
    with torch.no_grad():
        expected = network(spikes)
    torch.testing.assert_close(forward_in_tiles(network, spikes, 32), expected, rtol=0, atol=1e-5)


# F, G: search and refinement


@pytest.mark.parametrize("letter", ["a", "b", "c", "i", "j"])
def test_search_by_site_equals_search_by_pixel(letter, configs):
    network, (spikes, _) = variant(letter, configs), clip(1, 17, 20)
    flow = torch.tensor([[-2.5, 1.25], [2.5, -1.25]]).reshape(1, 2, 2, 1, 1).repeat(1, 1, 1, 17, 20)
    with torch.no_grad():
        by_site = network(spikes, flow)
    torch.testing.assert_close(by_site, network(spikes, flow.requires_grad_()), rtol=0, atol=1e-4)


def test_f_ignores_motion(configs):
    spikes, flow = clip(1, 70, 58)
    network = variant("f", configs, motion=Unwanted())
    assert network(spikes).equal(network(spikes, flow))
    torch.testing.assert_close(forward_in_tiles(network, spikes, 32), network(spikes), rtol=0, atol=1e-5)


# H, I: reconstruction


@pytest.mark.parametrize(("letter", "apart"), [("h", True), ("i", False), ("j", False)])
def test_colours_affect_each_other_except_in_h(letter, apart, configs):
    spikes, flow = clip()
    network = variant(letter, configs)
    before = network(spikes, flow)
    for color, mask in enumerate(bayer_mask(12, 16, dtype=torch.bool)):
        after = network(torch.where(mask, 1 - spikes, spikes), flow)
        changed = [not before[:, n].equal(after[:, n]) for n in range(3)]
        assert changed == ([n == color for n in range(3)] if apart else [True] * 3)


# checkpoints


@pytest.mark.parametrize("letter", "ce")
def test_checkpoint_of_another_variant_is_rejected(letter, configs):
    checkpoint = {"state_dict": {}}
    SuperResolution(variant("j", configs)).on_save_checkpoint(checkpoint)
    module = SuperResolution(variant(letter, configs), flow="estimated")
    name, value = next(iter(settings(configs, f"ablation/{letter}").items()))
    adapted = "; --model.weights adapts them" if name == "motion_fusion" else ""
    with pytest.raises(ValueError, match=f"this run asks for {name}={value}{adapted}"):
        module.on_load_checkpoint(checkpoint)

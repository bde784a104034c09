"""Profiles of pairs of known motion, and the plans made from them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from spikekit.scenes.adaptive_sampling import Plan, SceneProfile, profile_interval


class Steady:
    """Constant flow, in pixels of the given frames."""

    def __init__(self, x=0.0, y=0.0):
        self.velocity, self.sizes = torch.tensor([x, y]), []

    def __call__(self, first, second):
        self.sizes.append(tuple(first.shape))
        flow = self.velocity[:, None, None].expand(2, *first.shape[1:]).to(first)
        return SimpleNamespace(forward=flow, backward=-flow)


def profile_of(first, second, motion=None, **settings):
    return profile_interval(first, second, **({"scale": 2, "motion": motion or Steady()} | settings))


MOVING = SceneProfile((64, 64), 20, 0.0, (0, 0, 64, 64), 0.1, 0.02)


def test_static_scene_has_no_region():
    picture = torch.rand(3, 16, 24)
    profile = profile_of(picture, picture)
    assert (profile.static, profile.region, profile.displacement, profile.blending) == (1, None, 0, 0)


def test_displacement_is_in_sensor_pixels_per_clock():
    first, second = torch.rand(2, 3, 64, 64).unbind()
    profile = profile_of(first, second, Steady(0.75, 1.0), clocks=10)  # cells are two sensor pixels wide
    assert profile.displacement == pytest.approx(2 * 1.25 / 10)


def test_motion_is_estimated_only_around_changes():
    first = torch.rand(3, 160, 160)
    second = first.clone()
    second[:, 81:97, 60:62] = 1 - second[:, 81:97, 60:62]
    motion = Steady()
    profile = profile_of(first, second, motion)
    # sensor rows 40 to 48, columns 30 to 30
    assert profile.region == (40, 30, 9, 1)
    assert 1 - 9 / 6400 <= profile.static < 1
    assert motion.sizes[0][1] < 40
    assert motion.sizes[0][2] < 40


@pytest.mark.parametrize(("change", "static"), [(0.9, 1.0), (1.1, 0.0)])
def test_change_below_the_tolerance_is_ignored(change, static):
    first = torch.full((3, 16, 16), 0.5)
    step = change * 0.05 * 0.2 / 20 / 0.4  # of the charge of 20 clocks, per spike
    assert profile_of(first, first + step).static == static


def test_gain_is_not_taken_for_motion():
    first = 0.2 + 0.3 * torch.rand(3, 32, 32)
    seen = []

    def motion(one, other):
        seen.extend([one, other])
        return Steady()(one, other)

    profile = profile_of(first, 1.25 * first, motion)
    torch.testing.assert_close(seen[0], seen[1], atol=1e-3, rtol=0)
    assert profile.plan().latent == 0


@pytest.mark.parametrize(
    ("shape", "where", "flow", "back", "typical"),
    [
        ((1200, 32), np.s_[0, 100:101], 2.0, True, 1.0),  # one row of 300 may be faster
        ((1200, 32), np.s_[0, 100:112], 2.0, True, 2.0),
        ((64, 64), np.s_[0, :, 10:], 2.0, True, 1.0),  # in what is flat nothing is seen
        ((64, 64), np.s_[0, :, :4], 30.0, False, 1.0),  # there and back do not meet
    ],
)
def test_inconsistent_or_invisible_flow_is_ignored(shape, where, flow, back, typical):
    first, second = torch.rand(2, 3, *shape).unbind()
    if where == np.s_[0, :, 10:]:
        first[..., 24:], second[..., 24:] = 0.5, 0.7  # flat, and brighter at the next frame

    def motion(one, other):
        between = Steady(1.0)(one, other)
        forward = between.forward.clone()
        forward[where] = flow
        return SimpleNamespace(forward=forward, backward=-forward if back else between.backward)

    profile = profile_of(first, second, motion)
    assert profile.displacement == pytest.approx(2 * typical / 20, rel=0.3 if shape[0] == 64 else 1e-6)


def test_blending_along_a_diagonal():
    """A wave has curvature across its crests, and none along them."""
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
    first, second = ((0.5 + 0.4 * torch.sin((x + y) / 4 + phase)).expand(3, 64, 64) for phase in (0.0, 0.5))
    across, along = (profile_of(first, second, Steady(0.5, y)).blending for y in (0.5, -0.5))
    assert along < 0.2 * across


@pytest.mark.parametrize("backward", [torch.ones(2, 16, 16), None])
def test_everything_is_modelled_if_motion_is_not_found(backward):
    first, second = torch.rand(2, 3, 64, 64).unbind()
    forward = None if backward is None else torch.ones(2, 16, 16)  # there and back do not meet, or there is no flow
    profile = profile_of(first, second, lambda one, other: SimpleNamespace(forward=forward, backward=backward))
    assert profile.displacement == float("inf")
    assert profile.plan() == Plan.everything(20)


@pytest.mark.parametrize(
    ("displacement", "step", "latent"), [(0.0, 0.5, 0), (0.024, 0.5, 0), (0.026, 0.5, 1), (0.1, 0.5, 3), (0.1, 0.25, 7)]
)
def test_steps_stay_below_a_fraction_of_a_pixel(displacement, step, latent):
    plan = replace(MOVING, displacement=displacement).plan(step=step)
    assert plan.latent == latent
    assert displacement * 20 / (plan.latent + 1) <= step


def test_fine_detail_requires_more_latent_frames():
    assert replace(MOVING, blending=0.05 * 36).plan().latent == 5
    assert replace(MOVING, blending=0.05 * 36.1).plan().latent == 6
    assert replace(MOVING, blending=0.05 * 36).plan(spike_tolerance=0.2).latent == 3


def test_the_region_has_a_margin_and_whole_cells():
    small = replace(MOVING, size=(200, 300), region=(100, 150, 7, 5), displacement=0.1)
    top, left, height, width = small.plan().region
    assert top <= 90
    assert left <= 140
    assert top + height >= 117
    assert left + width >= 165
    assert not any(side % 2 for side in (top, left, height, width))
    top, left, height, width = replace(small, region=(0, 290, 3, 10)).plan().region
    assert top == 0
    assert left + width == 300
    assert replace(small, region=(10, 10, 180, 280)).plan().region is None
    assert replace(small, displacement=0.0).plan().region is None  # nothing is synthesised


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Plan(-1), "latent: expected 0 frames or more, got -1"),
        (lambda: Plan(1, (1, 0, 4, 4)), "region: expected an even row and column"),
    ],
)
def test_invalid_arguments_are_rejected(make, message):
    with pytest.raises(ValueError, match=message):
        make()

"""Latent frames: scenes of known motion, the ends, occlusions and cuts."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from spikekit import psnr
from spikekit.flow.interpolate import Between, Blend, FlowInterpolation, Still
from spikekit.scenes.analytic import Layer, Motion, Scene


def texture(height, width, seed=0, dtype=torch.float32):
    """Sum of blurred noise from coarse to fine, in [0, 1]."""
    white = np.random.default_rng(seed).normal(size=(3, 3, height, width))
    layers = [gaussian_filter(noise, (0, sigma, sigma)) for noise, sigma in zip(white, (1.5, 5, 15), strict=True)]
    noise = sum(layer / layer.std() for layer in layers)
    low, high = noise.min(), noise.max()
    return torch.from_numpy((noise - low) / (high - low)).to(dtype)


def panning(x, y, size=(96, 112), dtype=torch.float32):
    """A scene of 21 clocks that moves by (x, y) pixels from the first to the last."""
    picture = texture(size[0] + 80, size[1] + 80, dtype=dtype)
    return Scene([Layer(picture, Motion(velocity=(x / 20, y / 20)), (-40, -40))], *size, frames=21)


def passing(background=(-1.6, 1.2), front=(4.0, 0.0), size=(120, 120)):
    """A square before a background, which move by the given pixels from the first to the last of 21 clocks."""
    back = Layer(texture(200, 200), Motion((background[0] / 20, background[1] / 20)), (-40, -40))
    square = Layer(texture(48, 48, seed=1), Motion((front[0] / 20, front[1] / 20)), (36, 36), torch.ones(48, 48))
    return Scene([back, square], *size, frames=21)


def ends(scene):
    return scene.rgb(0), scene.rgb(20)


ALL = [Still(), Blend(), FlowInterpolation()]


# --- the ends, kinds of numbers, bad input ----------------------------------------------------------------------------


@pytest.mark.parametrize("method", ALL, ids=lambda method: type(method).__name__)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_ends_are_the_frames_bit_for_bit(method, dtype):
    first, second = (frame.to(dtype) for frame in ends(panning(3.0, 1.0)))
    between = method(first, second)
    assert isinstance(between, Between)
    assert between.at(0).equal(first)
    assert between.at(1.0).equal(second)
    assert between.at(0.3).dtype == dtype
    assert between.at(0.3).shape == first.shape
    for tau in (-0.01, 1.01, float("nan")):
        with pytest.raises(ValueError, match="tau"):
            between.at(tau)


@pytest.mark.parametrize("method", ALL, ids=lambda method: type(method).__name__)
def test_equal_frames_are_returned_unchanged(method):
    frame = texture(40, 50)
    between = method(frame, frame.clone())
    for tau in (0, 0.25, 0.5, 0.9, 1):
        assert torch.allclose(between.at(tau), frame, atol=1e-7, rtol=0)
    assert not between.cut
    if isinstance(method, FlowInterpolation):
        assert between.at(0.7).equal(frame)
        assert not between.forward.any()


@pytest.mark.parametrize("method", ALL, ids=lambda method: type(method).__name__)
def test_invalid_frames_are_rejected(method):
    frame = torch.rand(3, 20, 20)
    for first, second, name in (
        (frame[None], frame[None], "first"),
        (frame, frame[:, 1:], "second"),
        (frame, frame.double(), "second"),
    ):
        with pytest.raises(ValueError, match=name):
            method(first, second)


def test_frames_with_nan_or_infinity_are_rejected():
    frame = torch.rand(3, 20, 20)
    hole = frame.clone()
    hole[0, 3, 3] = float("nan")
    with pytest.raises(ValueError, match="NaN"):
        FlowInterpolation()(frame, hole)


@pytest.mark.parametrize("size", [(1, 1), (5, 3), (31, 45)])
@pytest.mark.parametrize("shrink", [1, 3])
def test_frames_of_any_size_are_interpolated(size, shrink):
    first, second = torch.rand(2, 3, *size).sort(dim=0).values
    picture = FlowInterpolation(shrink)(first, second).at(0.4)
    assert picture.shape == first.shape
    assert picture.isfinite().all()
    assert picture.min() >= first.min()
    assert picture.max() <= second.max()


# --- motion -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("x", "y"), [(1.0, 0.5), (10.0, 8.0)])
def test_known_translation_is_followed(x, y):
    scene = panning(x, y)
    between = FlowInterpolation(shrink=1)(*ends(scene))
    for tau in (0.25, 0.5, 0.8):
        truth = scene.rgb(20 * tau)
        blend = psnr(Blend()(*ends(scene)).at(tau), truth)
        made = psnr(between.at(tau), truth)
        assert made > (45 if abs(x) < 8 else 29), tau
        assert made > blend + 4, tau
    inner = (slice(None), slice(24, -24), slice(24, -24))
    for flow, sign in ((between.forward, 1), (between.backward, -1)):
        assert flow.shape == (2, 96, 112)
        error = flow[inner] - sign * torch.tensor([x, y]).reshape(2, 1, 1)
        assert error.abs().mean() < 0.1


def test_occluded_background_comes_from_the_frame_that_shows_it():
    scene, tau = passing(), 0.25
    truth = scene.rgb(20 * tau)
    made, blend = (method(*ends(scene)).at(tau) for method in (FlowInterpolation(), Blend()))
    left, top = 36 + 4 * (tau - 0.5), 36
    y, x = torch.meshgrid(torch.arange(120.0), torch.arange(120.0), indexing="ij")
    outside = torch.maximum((x - left - 23.5).abs(), (y - top - 23.5).abs()) - 24
    edge = outside.abs() < 4
    error, plain = ((picture - truth).abs().mean(dim=0)[edge].mean() for picture in (made, blend))
    assert error < 0.02 < plain


def ball(radius, pixels):
    """A white ball that moves to the right before a dark, still background."""
    axis = torch.arange(2.0 * radius + 1) - radius
    disc = (axis[:, None] ** 2 + axis**2 < radius**2).float()
    ball = Layer(torch.full((3, *disc.shape), 0.95), Motion((pixels / 20, 0.0)), (50, 50), disc)
    return Scene([Layer(texture(200, 200) * 0.6, position=(-40, -40)), ball], 120, 120, frames=21)


@pytest.mark.parametrize(("radius", "pixels", "tau", "least"), [(4, 10, 0.5, 40), (6, 16, 0.5, 34)])
def test_object_that_moves_farther_than_its_width(radius, pixels, tau, least):
    # half way, both frames show only background where the ball is: its motion must be carried there
    scene = ball(radius, pixels)
    assert psnr(FlowInterpolation()(*ends(scene)).at(tau), scene.rgb(20 * tau)) > least


@pytest.mark.parametrize("gain", [0.5, 1.3])
def test_changing_light_is_not_taken_for_motion(gain):
    scene = panning(2.0, 1.0)
    first, second = ends(scene)
    between = FlowInterpolation()(first * 0.7, second * 0.7 * gain)
    assert not between.cut
    assert psnr(between.at(0.5), scene.rgb(10) * 0.7 * (1 + gain) / 2) > 50


# --- cuts, chance -----------------------------------------------------------------------------------------------------


def test_at_a_cut_the_nearest_frame_is_shown():
    first, second = texture(80, 100, seed=0), texture(80, 100, seed=7)
    between = FlowInterpolation()(first, second)
    assert between.cut
    assert between.forward is None
    assert between.backward is None
    assert between.at(0.4).equal(first)
    assert between.at(0.6).equal(second)


@pytest.mark.parametrize("scene", [panning(10.0, -8.0), passing((3.0, 0.0), (-5.0, 0.0))])
def test_motion_and_noise_are_not_taken_for_a_cut(scene):
    noise = torch.randn(2, 3, scene.height, scene.width) * 0.03
    first, second = ends(scene)
    assert not FlowInterpolation()(first, second).cut
    assert not FlowInterpolation()((first + noise[0]).clamp(0, 1), (second + noise[1]).clamp(0, 1)).cut


def test_result_does_not_depend_on_the_number_of_threads():
    first, second = ends(panning(2.3, 1.1, size=(101, 99)))
    made, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            between = FlowInterpolation()(first, second)
            made.append([between.forward, between.at(0.3), between.at(0.7)])
    finally:
        torch.set_num_threads(before)
    assert all(one.equal(two) for one, two in zip(*made, strict=True))

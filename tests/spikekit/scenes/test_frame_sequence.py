"""Films: light against a loop over interpolated frames, ground truth, plans, flow and spikes."""

import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
import torch

from spikekit import bin_to_sensor, psnr, read_spikes, tfi, tfp, write_spikes
from spikekit.flow.interpolate import Blend, Still
from spikekit.scenes.adaptive_sampling import Plan, profile_interval
from spikekit.scenes.analytic import Layer, Motion, Scene
from spikekit.scenes.frame_sequence import FrameSequence
from spikekit.sensor.noise import SensorNoise
from spikekit.sensor.simulate import SpikeSensor, simulate_spikes


class Shift:
    """Exact interpolation of uniformly moving periodic pictures by Fourier shift; records its calls."""

    def __init__(self, x=0.0, y=0.0):
        self.velocity, self.calls, self.taus = (x, y), [], []

    def shifted(self, picture, share):
        rows, columns = torch.fft.fftfreq(picture.shape[1])[:, None], torch.fft.rfftfreq(picture.shape[2])
        turn = torch.exp(-2j * torch.pi * share * (columns * self.velocity[0] + rows * self.velocity[1]))
        return torch.fft.irfft2(torch.fft.rfft2(picture) * turn, picture.shape[1:])

    def __call__(self, first, second):
        self.calls.append(tuple(first.shape))
        flow = torch.tensor(self.velocity)[:, None, None].expand(2, *first.shape[1:])

        def at(tau):
            self.taus.append(tau)
            return first if tau == 0 else second if tau == 1 else self.shifted(first, tau)

        return SimpleNamespace(at=at, forward=flow, backward=-flow)


class Fade:
    """An interpolation that is not linear in time."""

    def __init__(self):
        self.calls = []

    def __call__(self, first, second):
        self.calls.append(tuple(first.shape))
        at = lambda tau: first + tau**2 * (second - first)  # noqa: E731
        return SimpleNamespace(at=at, forward=None, backward=None)


def smooth(height, width, cut=0.15, seed=0):
    """A periodic picture without fine detail, in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    spectrum = torch.fft.rfft2(torch.rand(3, height, width, generator=generator))
    rows, columns = torch.fft.fftfreq(height)[:, None], torch.fft.rfftfreq(width)
    picture = torch.fft.irfft2(spectrum * ((rows**2 + columns**2).sqrt() < cut), (height, width))
    return (picture - picture.min()) / (picture.max() - picture.min())


def moving(x, y=0.0, frames=3, size=64, scale=2, **settings):
    """A film that moves by (x, y) sensor pixels per interval, with exact interpolation and motion."""
    exact = Shift(x * scale, y * scale)
    picture = smooth(size, size, settings.pop("cut", 0.15))
    shots = [exact.shifted(picture, float(n)).clamp(0, 1) for n in range(frames)]
    motion = Shift(x / 2, y / 2)
    return FrameSequence(shots, scale=scale, interpolation=exact, motion=motion, **settings)


# --- truth and light --------------------------------------------------------------------------------------------------


def test_ground_truth_is_the_frame_cropped_from_the_top_left():
    frames = [torch.rand(3, 37, 50) for _ in range(3)]
    film = FrameSequence(frames, scale=3)
    assert (film.height, film.width, film.clock_count) == (36, 48, 41)
    for n in range(3):
        assert film.rgb(n).equal(frames[n][:, :36, :48])
        assert film.light(20 * n, 1)[0].equal(0.4 * bin_to_sensor(frames[n][:, :36, :48], scale=3))


@pytest.mark.parametrize("pattern", ["RGGB", "GBRG"])
@pytest.mark.parametrize("latent", [1, 2, 19])
def test_light_is_blended_between_latent_frames(pattern, latent):
    frames = [torch.rand(3, 16, 12) for _ in range(3)]
    film = FrameSequence(frames, scale=2, pattern=pattern, alpha=0.7, interpolation=Fade(), plan=Plan(latent))
    light = film.light()
    assert light.shape == (41, 8, 6)
    steps = latent + 1

    def knot(frame, number):
        first, second = frames[frame], frames[frame + 1]
        picture = first + (number / steps) ** 2 * (second - first)
        return 0.7 * bin_to_sensor(picture, pattern, scale=2)

    for clock in range(40):
        frame, phase = clock // 20, clock % 20
        before = phase * steps // 20
        share = phase * steps / 20 - before
        expected = (
            knot(frame, before) if share == 0 else (1 - share) * knot(frame, before) + share * knot(frame, before + 1)
        )
        torch.testing.assert_close(light[clock], expected, atol=1e-6, rtol=0)
    if latent == 19:
        assert light[7].equal(knot(0, 7))


def test_region_is_interpolated_and_the_rest_blended():
    frames, interpolation = [torch.rand(3, 32, 48) for _ in range(2)], Fade()

    def light(plan):
        return FrameSequence(frames, scale=2, pattern="GBRG", interpolation=interpolation, plan=plan).light()

    part, whole, blended = light(Plan(19, (4, 6, 8, 10))), light(Plan(19)), light(Plan())
    assert interpolation.calls[0] == (3, 16, 20)
    inside = slice(4, 12), slice(6, 16)
    assert part[(..., *inside)].equal(whole[(..., *inside)])
    assert not part[(..., *inside)].equal(blended[(..., *inside)])
    part[(..., *inside)] = blended[(..., *inside)]
    assert part.equal(blended)


def test_result_does_not_depend_on_spans():
    film = moving(3.0, frames=4)
    whole = film.light()
    assert whole.shape == (61, 32, 32)
    for first, count in ((59, 2), (0, 1), (13, 30), (20, 20), (60, 1), (7, 3)):
        assert moving(3.0, frames=4).light(first, count).equal(whole[first : first + count])
        assert film.light(first, count).equal(whole[first : first + count])


def test_frames_are_read_lazily():
    class Frames(list):
        read = ()

        def __getitem__(self, index):
            self.read = (*self.read, index)
            return super().__getitem__(index)

    frames = Frames(torch.rand(3, 8, 8) for _ in range(9))
    film = FrameSequence(frames, scale=2, plan=Plan())
    assert frames.read == (0,)
    film.clip(5).light()
    assert frames.read == (0, 4, 5, 6)


def test_a_film_of_one_frame():
    film = FrameSequence([torch.rand(3, 8, 8)], scale=2)
    assert film.light().shape == (1, 4, 4)
    assert film.flow(0, 0).equal(torch.zeros(2, 4, 4))


# --- plans ------------------------------------------------------------------------------------------------------------


def test_a_static_film_costs_no_interpolation():
    picture = torch.rand(3, 16, 16)
    film = FrameSequence([picture] * 3, scale=2, interpolation=Fade(), motion=Shift(1.0))
    light = film.light()
    assert film.interpolation.calls == []
    assert film.motion.calls == []
    assert light.equal(light[:1].expand_as(light))


def test_cut_shows_the_nearest_frame():
    frames = [smooth(64, 64, seed=n) for n in range(2)]
    light = FrameSequence(frames, scale=2).light()
    assert light[:10].equal(light[:1].expand(10, -1, -1))
    assert light[10:].equal(light[-1:].expand(11, -1, -1))


@pytest.mark.parametrize("interpolation", [Blend(), Still()])
def test_interpolations_without_motion_need_no_profile(interpolation):
    motion = Shift(1.0)
    frames = list(torch.rand(2, 3, 16, 16))
    planned = FrameSequence(frames, scale=2, interpolation=interpolation, motion=motion).light()
    everything = FrameSequence(frames, scale=2, interpolation=interpolation, plan=Plan.everything(20)).light()
    torch.testing.assert_close(planned, everything)
    assert motion.calls == []


@pytest.mark.parametrize(("pixels", "latent"), [(0.9, 1), (2.4, 4), (4.9, 9)])
def test_number_of_latent_frames_follows_the_motion(pixels, latent):
    film = moving(pixels, cut=0.03)
    film.light(0, 21)
    assert film.plan(0).latent == latent
    assert len([tau for tau in film.interpolation.taus if 0 < tau < 1]) == latent


def test_every_interval_has_its_own_plan():
    exact = Shift(2.0)
    still, moved = smooth(64, 64), exact.shifted(smooth(64, 64), 1.0).clamp(0, 1)
    film = FrameSequence([still, still, moved], scale=2, interpolation=exact, motion=Shift(0.5))
    assert film.plan(0).latent == 0
    assert film.plan(1).latent > 0


def changed(light, other):
    draws = (4, *light.shape)
    streams = [
        simulate_spikes(each.expand(draws), generator=torch.Generator().manual_seed(0)) for each in (light, other)
    ]
    return (streams[0] != streams[1]).sum().item() / streams[1].sum().item(), streams


@pytest.mark.parametrize("cut", [0.05, 0.5])
@pytest.mark.parametrize("pixels", [0.2, 0.7, 6.0])
@pytest.mark.parametrize("tolerance", [0.05, 0.01])
def test_planned_streams_stay_within_the_tolerance(pixels, cut, tolerance):
    planned = moving(pixels, pixels / 3, cut=cut, spike_tolerance=tolerance, frames=3)
    everything = moving(pixels, pixels / 3, cut=cut, plan=Plan.everything(20))
    share, streams = changed(planned.light(), everything.light())
    assert share <= tolerance
    truth = planned.light(20, 1)
    decoded = [torch.stack([tfp(stream, 41)[:, 20], tfi(stream)[:, 20]]).unsqueeze(2) / 0.4 for stream in streams]
    quality = [psnr(raw.expand(-1, -1, 3, -1, -1), (truth / 0.4).expand(2, 4, 3, -1, -1)).mean(1) for raw in decoded]
    torch.testing.assert_close(*quality, atol=0.1, rtol=0)


@pytest.mark.parametrize("cut", [0.08, 0.3])
@pytest.mark.parametrize("pixels", [0.3, 0.6])
def test_estimated_error_of_blending(pixels, cut):
    blended = moving(pixels, cut=cut, plan=Plan())
    found = changed(blended.light(), moving(pixels, cut=cut, plan=Plan.everything(20)).light())[0]
    profile = profile_interval(blended.rgb(0), blended.rgb(1), scale=blended.scale, motion=blended.motion)
    assert found < profile.blending < 5 * found


# --- flow, clips, spikes ----------------------------------------------------------------------------------------------


def test_flow_equals_that_of_the_scene():
    """Motion to the right and down, in sensor pixels, forwards and backwards over two intervals."""
    motion = Motion((0.3, -0.15))
    scene = Scene([Layer(torch.rand(3, 80, 80), motion, (-20, -20))], 32, 32, frames=41)
    frames = [scene.rgb(clock) for clock in (0, 10, 20, 30, 40)]
    film = FrameSequence(frames, scale=4, clocks=10, interpolation=Shift(3.0, -1.5), motion=Shift(3.0 / 8, -1.5 / 8))
    for clock in (0, 3, 10, 20, 25, 33.5, 40):
        torch.testing.assert_close(film.flow(2, clock), scene.flow(clock, scale=4), atol=1e-5, rtol=0)
        torch.testing.assert_close(film.clip(2).flow(clock), scene.flow(clock, scale=4), atol=1e-5, rtol=0)


def test_flows_of_several_intervals_are_concatenated():
    """The flow of the second interval is sampled at the displaced position."""
    far = torch.zeros(2, 8, 32)
    far[0] = torch.arange(32.0)

    def interpolation(first, second):
        one = torch.zeros(2, 8, 32)
        one[0] = 4.0
        return SimpleNamespace(forward=one if first.mean() < 0.1 else far, backward=None)

    film = FrameSequence(
        [torch.full((3, 8, 32), value) for value in (0.0, 0.5, 1.0)], scale=2, interpolation=interpolation
    )
    film.fixed = Plan()
    expected = (4 + (torch.arange(32.0) + 4).clamp(max=31)).reshape(16, 2).mean(1) / 2
    torch.testing.assert_close(film.flow(0, 40)[0], expected.expand(4, 16))


def test_a_clip_is_a_scene():
    film = moving(2.0, frames=5)
    clip = film.clip(2)
    assert (clip.frames, clip.middle, clip.first, clip.height, clip.width) == (41, 20, 20, 64, 64)
    assert clip.light().equal(film.light(20, 41))
    assert clip.rgb(clip.middle).equal(film.rgb(2))
    assert clip.rgb(40).equal(film.rgb(3))
    assert clip.flow(25, scale=2).equal(film.flow(2, 45))
    assert film.clip(1, 30).first == 5
    assert film.clip(2, 50).light().shape[0] == 50
    with pytest.raises(ValueError, match="needs frames -1 to 3"):
        film.clip(1, 50)
    with pytest.raises(ValueError, match="expected 2, that of the sequence, got 4"):
        clip.flow(3, scale=4)
    with pytest.raises(ValueError, match="expected the clock of a source frame"):
        clip.rgb(19)


def test_spikes_of_a_span_equal_those_of_the_whole(tmp_path):
    film, noise = moving(2.0), SensorNoise(photons=100.0, dark_current=0.01)
    whole = SpikeSensor(noise, seed=3).expose(film.light())
    for chunk in (1, 16, 64):
        assert torch.cat(list(film.spikes(noise=noise, seed=3, chunk=chunk))).equal(whole)
    write_spikes(tmp_path / "film.dat", film.spikes(noise=noise, seed=3, chunk=7))
    assert read_spikes(tmp_path / "film.dat", 32, 32).equal(whole)
    assert not torch.cat(list(film.spikes(noise=noise, seed=4))).equal(whole)


FRAMES = [torch.rand(3, 8, 8) for _ in range(3)]


def film_of(frames=FRAMES, **settings):
    return FrameSequence(frames, **{"scale": 2, **settings})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: film_of([]), "frames: expected at least one, got none"),
        (lambda: film_of(scale=5), "frames: expected 10 x 10 pixels or more, got 8 x 8"),
        (lambda: film_of([torch.rand(4, 8, 8)]), r"frames\[0\]: expected \(3, H, W\), got \(4, 8, 8\)"),
        (
            lambda: film_of([*FRAMES, torch.rand(3, 8, 9)]).light(),
            r"frames\[3\]: expected 8 x 8 as the first frame, got 8 x 9",
        ),
        (lambda: film_of().light(0, 42), "first, count: expected clocks of the film, 0 to 40, got 42 from 0 on"),
        (lambda: film_of().rgb(3), "frame: expected 0 to 2, got 3"),
        (lambda: film_of().plan(2), "interval: expected 0 to 1, got 2"),
        (lambda: film_of().flow(1, 41), "clock: expected 0 to 40, got 41"),
        (lambda: film_of(interpolation=Fade(), plan=Plan()).flow(1, 3), "no flow from frame 1"),
        (lambda: film_of().clip(0), r"needs frames -1 to 1, got 0 to 2"),
    ],
)
def test_invalid_arguments_are_rejected(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_several_threads_share_a_sequence():
    frames = [torch.rand(3, 8, 12, generator=torch.Generator().manual_seed(n)) for n in range(20)]
    sequence = FrameSequence(frames, scale=2, clocks=3, interpolation=Blend())
    firsts = [7 * n % 50 for n in range(64)]
    expected = [FrameSequence(frames, scale=2, clocks=3, interpolation=Blend()).light(first, 6) for first in firsts]
    before = sys.getswitchinterval()
    try:
        sys.setswitchinterval(1e-6)
        with ThreadPoolExecutor(8) as pool:
            found = list(pool.map(lambda first: sequence.light(first, 6), firsts))
    finally:
        sys.setswitchinterval(before)
    assert all(one.equal(other) for one, other in zip(found, expected, strict=True))

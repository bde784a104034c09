"""Calibration: rates against brute force, recovery of a known sensor, and correction to an ideal one."""

import pytest
import torch

from spikekit import bayer_mask, correct_spikes, demosaic, fill_defects, psnr, tfi_at
from spikekit.calibration.calibration import Calibration
from spikekit.calibration.measure import calibrate, find_defects
from spikekit.calibration.pixel_rates import PixelRates
from spikekit.sensor.noise import DEAD, HOT, WORKS, SensorNoise
from spikekit.sensor.simulate import SpikeSensor

SIZE = 40, 48


def chance(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.fixture(name="truth", scope="module")
def _truth():
    """A sensor with gains of SD 8 % and mean 1 in every colour, dark rates, and 1 % dead and 1 % hot pixels."""
    gain = 1 + 0.08 * torch.randn(SIZE, generator=chance(1)).clamp(-3, 3)
    dark = 0.01 * torch.rand(SIZE, generator=chance(2))
    lot = torch.rand(SIZE, generator=chance(3))
    defects = (lot < 0.01) * DEAD + (lot > 0.99) * HOT
    for colour in bayer_mask(*SIZE, "BGGR").bool():
        gain[colour] /= gain[colour & (defects == WORKS)].mean()
    gain[defects != WORKS], dark[defects != WORKS] = 1, 0
    return Calibration(gain, dark, defects.byte())


def halves(spikes):
    middle = len(spikes) // 2
    return PixelRates.of(spikes[:middle].split(70)), PixelRates.of(spikes[middle:].split(300))


def brute_force(times, frames):
    times = [t for t, fired in enumerate(times) if fired]
    return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else len(times) / frames


@pytest.mark.parametrize(("share", "chunk"), [(0.004, 7), (0.05, 1), (0.6, 100)])
def test_rates_are_measured_between_the_first_and_the_last_spike(share, chunk):
    spikes = torch.rand(100, 5, 6, generator=chance()) < share
    found = PixelRates.of(spikes.split(chunk)).rate
    expected = [brute_force(pixel, 100) for pixel in spikes.flatten(1).T.tolist()]
    assert found.dtype == torch.float64
    assert found.flatten().tolist() == pytest.approx(expected, rel=1e-15)


def test_a_sensor_is_recovered_from_a_flat_and_a_dark_recording(truth):
    noise = SensorNoise(photons=1000, calibration=truth)
    flat = SpikeSensor(noise, seed=5).expose(torch.full((1000, *SIZE), 0.15))
    dark = SpikeSensor(noise, seed=6).expose(torch.zeros(2000, *SIZE))
    found = calibrate(halves(flat), halves(dark), "BGGR")
    assert found.calibration.defects.equal(truth.defects)
    works = truth.defects == WORKS
    for name, stated in (("gain", found.gain_error), ("dark", found.dark_error)):
        error = (getattr(found.calibration, name) - getattr(truth, name))[works].square().mean().sqrt()
        assert 0.3 * stated < error < 1.3 * stated, name
    assert found.gain_error < 0.005
    assert found.dark_error < 3e-4


def test_one_recording_alone_gives_a_part_of_the_calibration(truth):
    noise = SensorNoise(calibration=truth)
    flat = calibrate(halves(SpikeSensor(noise).expose(torch.full((400, *SIZE), 0.3))), None, "BGGR")
    assert flat.dark_error is None
    assert not flat.calibration.dark.any()
    assert flat.calibration.defects.equal(truth.defects)
    dark = calibrate(None, halves(SpikeSensor(noise).expose(torch.zeros(400, *SIZE))), "BGGR")
    assert (dark.calibration.gain == 1).all()
    assert (dark.calibration.defects == HOT).equal(truth.defects == HOT)
    ramp = torch.linspace(0.2, 0.6, SIZE[1]).expand(400, *SIZE) * (1 + bayer_mask(*SIZE, "BGGR")[1])
    scene = find_defects(PixelRates.of([SpikeSensor(noise).expose(0.35 * ramp)]), "BGGR")
    assert scene.calibration.defects.equal(truth.defects)


@pytest.mark.parametrize(
    ("light", "said"), [(1.0, "without saturation"), (0.0, "twice as bright as the dark one")], ids=["white", "black"]
)
def test_a_flat_recording_of_the_wrong_brightness_is_rejected(light, said):
    flat = SpikeSensor().expose(torch.full((200, 4, 4), light))
    with pytest.raises(ValueError, match=said):
        calibrate(halves(flat), halves(torch.zeros(200, 4, 4)))


# What is done with it


def test_true_calibration_recovers_the_rates_of_an_ideal_sensor(truth):
    light = torch.rand(3, *SIZE, generator=chance(7)) * 0.5
    light = torch.where(truth.defects != 0, 0.25, light)
    rate = truth.gain * light + truth.dark
    found = truth.correct(torch.where(truth.defects == HOT, 1.0, rate), "BGGR")
    works = truth.defects == WORKS
    torch.testing.assert_close(found[:, works], light[:, works], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("pattern", [None, "RGGB", "GBRG"])
def test_defects_are_filled_from_the_nearest_pixels_of_their_colour(truth, pattern):
    light = torch.rand(SIZE, generator=chance(8), dtype=torch.float64)
    found = Calibration(torch.ones(SIZE), torch.zeros(SIZE), truth.defects).correct(light, pattern)
    seen = torch.zeros(SIZE) if pattern is None else bayer_mask(*SIZE, pattern).argmax(0)
    bad = (truth.defects != WORKS).nonzero().tolist()
    assert len(bad) > 20
    for y, x in bad:
        others = [
            (((y - v) ** 2 + (x - u) ** 2) ** 0.5, light[v, u].item())
            for v in range(max(0, y - 6), min(SIZE[0], y + 7))
            for u in range(max(0, x - 6), min(SIZE[1], x + 7))
            if seen[v, u] == seen[y, x] and truth.defects[v, u] == WORKS
        ]
        others.sort()
        # which of equally distant ones are taken is open: between the least and the most that any choice gives
        far = others[3][0]
        near, equal = [o for o in others if o[0] < far], sorted(o[1] for o in others if o[0] == far)
        count = 4 - len(near)
        weight = sum(1 / d for d, _ in near) + count / far
        low, high = (
            (sum(value / d for d, value in near) + sum(part) / far) / weight for part in (equal[:count], equal[-count:])
        )
        assert low - 1e-9 <= found[y, x] <= high + 1e-9
    works = truth.defects == WORKS
    assert found[works].equal(light[works])


@pytest.mark.parametrize(("pattern", "step"), [(None, 1), ("GBRG", 2)])
def test_defects_of_a_clip_take_the_spikes_of_the_median_neighbour(pattern, step):
    whole = SpikeSensor().expose((0.1 + 0.3 * torch.rand(SIZE, generator=chance(9))).expand(2, 41, *SIZE))
    whole[..., 20], whole[..., 26] = 0, 1  # thin lines are no defects
    clips = whole.clone()
    bad = [(0, 0), (5, 7), (39, 30), (12, 46)]
    for n, (y, x) in enumerate(bad):
        clips[..., y, x] = n % 2
    filled = fill_defects(clips, pattern)
    for clip, made in zip(clips, filled, strict=True):
        for y, x in bad:
            near = [(abs(y + v), abs(x + u)) for v in (-step, 0, step) for u in (-step, 0, step) if (u, v) != (0, 0)]
            streams = [clip[:, min(v, 78 - v), min(u, 94 - u)].tolist() for v, u in near]
            median = sorted(map(sum, streams))[3]
            assert made[:, y, x].tolist() in [stream for stream in streams if sum(stream) == median]
            made[:, y, x] = clip[:, y, x]
    assert filled.equal(clips)
    for size in ((1, 1), (2, 2), (3, 1)):
        assert fill_defects(clips[..., : size[0], : size[1]], pattern).shape == (2, 41, *size)


def test_corrected_spikes_have_the_rate_of_an_ideal_sensor(truth):
    light = torch.linspace(0.05, 0.4, SIZE[1]).expand(41, *SIZE)
    spikes = SpikeSensor(SensorNoise(calibration=truth), seed=2).expose(light)
    found = correct_spikes(spikes, truth, "BGGR")
    assert found.dtype == spikes.dtype
    assert set(found.unique().tolist()) == {0, 1}
    # the count of an ideal sensor: off by one at each end, and by what an interval at the ends does not say
    works = truth.defects == WORKS
    assert ((found.sum(0) - light.sum(0)).abs()[works] < 2.5).all()
    with pytest.raises(ValueError, match=r"spikes: expected .* as the calibration, got 3 x 4"):
        correct_spikes(spikes[:, :3, :4], truth, "BGGR")
    first = spikes.argmax(0, keepdim=True)
    assert (found.gather(0, first)[0, works] == 1).all()
    ideal = Calibration(torch.ones(SIZE), torch.zeros(SIZE), truth.defects)
    again = correct_spikes(torch.stack([spikes, spikes]).bool(), ideal, "BGGR")
    assert again[1][:, works].equal(spikes.bool()[:, works])
    assert not again[0][:, truth.defects == HOT].all(0).any()


def test_gradients_of_spikes_go_to_the_pixel_they_are_from(truth):
    spikes = SpikeSensor().expose(torch.full((41, *SIZE), 0.3)).double()
    spikes[:, 5, 7] = 0  # dead
    spikes.requires_grad_()
    gain = torch.ones(SIZE)
    gain[:, 20:] = 1.1
    known = Calibration(gain, torch.zeros(SIZE), truth.defects)
    (passed,) = torch.autograd.grad(correct_spikes(spikes, known).sum(), spikes)
    assert passed.equal(((gain == 1) & (truth.defects == WORKS)).double().expand(41, *SIZE))
    (passed,) = torch.autograd.grad(fill_defects(spikes).sum(), spikes)
    assert (passed[0, 5, 7], passed[0, 4:7, 6:9].sum(), passed.sum()) == (0, 9, passed.numel())


def test_corrected_pictures_are_close_to_those_of_an_ideal_sensor(truth):
    y, x = torch.meshgrid(torch.linspace(0, 6, SIZE[0]), torch.linspace(0, 6, SIZE[1]), indexing="ij")
    light = (0.2 + 0.1 * torch.sin(x + y)).expand(101, *SIZE)
    ideal = SpikeSensor(seed=3).expose(light)
    real = SpikeSensor(SensorNoise(calibration=truth), seed=3).expose(light)

    def error(spikes, correct=lambda raw: raw):
        raw = correct(tfi_at(spikes.float(), 50))
        return psnr(demosaic(raw[None] / 0.4, "BGGR"), (light[50] / 0.4).expand(1, 3, *SIZE)).item()

    best = error(ideal)
    assert error(real) < best - 5
    assert error(real, lambda raw: truth.correct(raw, "BGGR")) > best - 0.5
    assert error(correct_spikes(real, truth, "BGGR")) > best - 1.5


# What is refused, and the noise of a measured sensor


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"gain": torch.zeros(2, 3)}, "gain: expected 0.0001 to 10000, got 0"),
        ({"gain": torch.ones(2, 3, dtype=torch.float64)}, "gain: expected .H, W. of torch.float32"),
        ({"dark": torch.full((2, 3), -1.0)}, "dark: expected 0 to 1, got -1"),
        ({"dark": torch.full((2, 3), float("nan"))}, "dark: expected 0 to 1, got nan"),
        ({"dark": torch.zeros(3, 2)}, "dark: expected .H, W."),
        ({"defects": torch.full((2, 3), 3, dtype=torch.uint8)}, "defects: expected 0 to 2, got 3"),
    ],
)
def test_invalid_values_are_rejected(changed, said):
    good = {"gain": torch.ones(2, 3), "dark": torch.zeros(2, 3), "defects": torch.zeros(2, 3, dtype=torch.uint8)}
    with pytest.raises(ValueError, match=said):
        Calibration(**(good | changed))


def test_a_colour_without_working_pixels_is_rejected():
    with pytest.raises(ValueError, match="working pixels of every colour"):
        Calibration(*torch.ones(2, 2, 2), torch.eye(2).byte()).correct(torch.ones(2, 2), "RGGB")


def test_simulated_pixels_are_those_of_the_measured_sensor(truth):
    noise = SensorNoise(calibration=truth)
    spikes = SpikeSensor(noise).expose(torch.full((500, *SIZE), 0.2))
    expected = torch.where(truth.defects == WORKS, 0.2 * truth.gain + truth.dark, (truth.defects == HOT).float())
    assert ((spikes.float().mean(0) - expected).abs() <= 1 / 500 + 1e-6).all()
    with pytest.raises(ValueError, match="light: expected 40 x 48 as the calibration, got 8 x 8"):
        SpikeSensor(noise).expose(torch.ones(3, 8, 8))
    with pytest.raises(ValueError, match="gain_spread: expected 0 with a calibration"):
        SensorNoise(gain_spread=0.1, calibration=truth)


def test_calibration_is_kept_whatever_the_scene_requires(truth):
    required = SensorNoise(photons=1e9, calibration=truth).required(0.2, 41, 0.5)
    assert required.photons is None
    assert required.calibration is truth

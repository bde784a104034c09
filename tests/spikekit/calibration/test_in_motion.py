"""Gains from a moving scene: recovered if possible, and never invented."""

import pytest
import torch
import torch.nn.functional as F
from torch.testing import assert_close

from spikekit import SensorNoise, SpikeSensor, bayer_mask
from spikekit.calibration.calibration import Calibration
from spikekit.calibration.in_motion import calibrate_in_motion, count_segments, segment_length
from spikekit.calibration.measure import find_defects
from spikekit.calibration.pixel_rates import PixelRates
from spikekit.sensor.noise import DEAD, HOT, WORKS

SIZE, FRAMES = (44, 56), 480


def chance(seed):
    return torch.Generator().manual_seed(seed)


def pictures(motion, times, size=SIZE):
    """A blurred texture (T, 3, H, W), of colours that go together as those of scenes do; it moves by (x, y) a frame."""
    margin = 48
    shape = (1, 3, size[0] + 2 * margin, size[1] + 2 * margin)
    big = torch.rand(shape, generator=chance(0))
    big = F.avg_pool2d(F.pad(0.8 * big[:, :1] + 0.2 * big, (3, 3, 3, 3), "reflect"), 7, 1)
    big = ((big - big.mean()) * 5 + 0.5).clamp(0.05, 1)
    y, x = torch.meshgrid(*(torch.arange(n) + margin for n in size), indexing="ij")

    def place(centre, n):
        return 2 * (centre + 0.5) / n - 1

    return torch.cat(
        [
            F.grid_sample(
                big,
                torch.stack([place(x - t * motion[0], shape[3]), place(y - t * motion[1], shape[2])], -1)[None],
                mode="bilinear",
                align_corners=False,
            )
            for t in times
        ]
    )


def raw(rgb, pattern):
    return rgb.mean(1) if pattern is None else (rgb * bayer_mask(*rgb.shape[-2:], pattern)).sum(1)


@pytest.fixture(name="truth", scope="module")
def _truth():
    """A sensor with gains of SD 6 %, dark rates and a few defects."""
    gain = 1 + 0.06 * torch.randn(SIZE, generator=chance(1)).clamp(-3, 3)
    dark = 0.004 * (1 + 0.4 * torch.randn(SIZE, generator=chance(2))).clamp(0, 2)
    lot = torch.rand(SIZE, generator=chance(3))
    defects = ((lot < 0.005) * DEAD + (lot > 0.995) * HOT).byte()
    gain[defects != WORKS], dark[defects != WORKS] = 1, 0
    return Calibration(gain, dark, defects)


@pytest.fixture(name="recording", scope="module")
def _recording(truth):
    """Record a moving scene, by Bayer phase."""
    rgb = pictures((0.05, -0.03), range(FRAMES))
    sensor = SpikeSensor(SensorNoise(photons=3000, calibration=truth), seed=4)
    return rgb, {pattern: sensor.expose(0.25 * raw(rgb, pattern)) for pattern in (None, "BGGR")}


def measured(spikes, pattern, known=None):
    known = known or find_defects(PixelRates.of([spikes]), pattern).calibration
    return calibrate_in_motion(count_segments(spikes.split(70), 20), known, pattern)


def alike(found, expected, works):
    return torch.corrcoef(torch.stack([found[works], expected[works]]))[0, 1].item()


@pytest.mark.parametrize("pattern", [None, "BGGR"])
def test_gains_are_found(truth, recording, pattern):
    found = measured(recording[1][pattern], pattern)
    known, works = found.calibration, truth.defects == WORKS
    assert known.defects.equal(truth.defects)
    assert alike(known.gain, truth.gain, works) > 0.8
    error = (known.gain - truth.gain)[works].std().item()
    assert error < 0.03
    assert 0.5 * error < found.gain_error < 1.5 * error, "it knows how exact it is"
    assert found.dark_error is None
    assert not known.dark.any()
    colours = bayer_mask(*SIZE, pattern).bool() if pattern else torch.ones(1, *SIZE).bool()
    assert_close(
        torch.stack([known.gain[c & works].mean() for c in colours]), torch.ones(len(colours)), atol=1e-4, rtol=0
    )


@pytest.mark.parametrize(("motion", "ideal"), [((0.05, -0.03), True), ((0.0, 0.0), False), ((0.006, 0.004), False)])
def test_ideal_sensor_and_still_texture_give_no_gains(truth, motion, ideal):
    noise = SensorNoise(photons=3000) if ideal else SensorNoise(calibration=truth)
    light = 0.25 * raw(pictures(motion, range(FRAMES)), "BGGR")
    assert measured(SpikeSensor(noise, seed=6).expose(light), "BGGR") is None


def test_gains_are_found_in_flickering_light(truth, recording):
    lamp = 1 + 0.3 * torch.sin(torch.arange(FRAMES) * 2 * torch.pi / 160)
    light = 0.2 * raw(recording[0], "BGGR") * lamp[:, None, None]
    known = measured(SpikeSensor(SensorNoise(calibration=truth), seed=7).expose(light), "BGGR").calibration
    assert alike(known.gain, truth.gain, truth.defects == WORKS) > 0.8


@pytest.mark.parametrize("chunk", [7, 45])
def test_counts_do_not_depend_on_the_chunks(chunk):
    spikes = torch.rand(100, 3, 4, generator=chance(8)) < 0.3
    found = count_segments(spikes.split(chunk), 30)
    assert found.frames == 30
    assert found.counts.equal(spikes[:90].reshape(3, 30, 3, 4).sum(1).byte())


@pytest.mark.parametrize(("size", "pattern"), [((1, 1), None), ((1, 40), "BGGR"), ((5, 40), "BGGR")])
@pytest.mark.parametrize("share", [0.0, 0.3])
def test_recordings_without_visible_motion_give_no_gains(size, pattern, share):
    spikes = torch.rand(260, *size, generator=chance(10)) < share
    ideal = Calibration(torch.ones(size), torch.zeros(size), torch.zeros(size, dtype=torch.uint8))
    assert measured(spikes, pattern, ideal) is None


def test_segment_length_follows_the_light():
    assert [segment_length(rate) for rate in (0.5, 0.1, 0.05, 0.02, 0.0)] == [20, 20, 40, 100, 200]

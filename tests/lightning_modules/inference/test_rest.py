"""Films of which only what moves is computed."""

import math

import pytest
import torch

from lightning_modules.inference.clips import film_groups
from lightning_modules.inference.film import FilmMaker
from lightning_modules.inference.rest import CELL, find_changes, find_misfits
from lightning_modules.networks import CSCSR, RecurrentCSCSR
from spikekit import Calibration, SensorNoise, flow_warp, simulate_spikes
from spikekit.scenes import Layer, Motion, Scene

TINY = {"scale": 2, "width": 8, "representation_width": 8, "features": 1, "stages": 1, "end_blocks": 1}
EVERY, SIDE = 20, 64


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def texture(side, scale=1):
    coarse = torch.rand(1, 3, side // 4, side // 4, generator=generator(1))
    return torch.nn.functional.interpolate(coarse, scale_factor=4 * scale, mode="bicubic")[0].clamp(0.05, 0.95)


def counts(light, before, after, seed=0):
    spikes = simulate_spikes(light.expand(before + after, -1, -1), generator=generator(seed)).float()
    return spikes[before:].sum(0), spikes[:before].sum(0)


@pytest.mark.parametrize("clocks", [20, 400])
@pytest.mark.parametrize("bright", [1.0, 0.3, 0.01, 0.0])
def test_cells_at_rest_are_rarely_taken_for_moved(clocks, bright):
    light = bright * torch.rand(256, 256, generator=generator())
    found = (find_changes(*counts(light, clocks, 20, seed), 20 / clocks) for seed in range(4))
    assert sum(moved.sum() for moved, _, _ in found) <= 1


@pytest.mark.parametrize(("recent", "reference"), [(20, 200), (160, 160)])
def test_a_shift_of_half_a_pixel_is_seen_in_nearly_every_textured_cell(recent, reference):
    picture = texture(2 * SIDE + 8)[0]
    first, second = (0.4 * picture[: 2 * SIDE : 2, at : at + 2 * SIDE : 2] for at in (0, 1))
    for seed in range(8):
        found = find_changes(
            counts(second, 20, recent, seed)[0], counts(first, reference, 1, seed + 9)[1], recent / reference
        )
        assert found[0].float().mean() > 0.95


@pytest.mark.parametrize(("around", "light", "side"), [(0.2, 0.35, 2), (0.005, 0.1, 1)])
def test_something_smaller_than_a_cell_is_seen_and_only_where_it_is(around, light, side):
    scene = torch.full((SIDE, SIDE), around)
    reference = counts(scene, 60, 20)[1]
    scene[21 : 21 + side, 34 : 34 + side] = light
    moved = find_changes(counts(scene, 60, 20, 1)[0], reference, 20 / 60)[0]
    assert moved.nonzero().tolist() == [[2, 4]]


@pytest.mark.parametrize(("side", "spikes"), [(1, 0.54), (2, 0.39), (4, 0.29)])
def test_a_faint_change_of_any_fineness_is_seen(side, spikes):
    sign = 1 - 2 * (torch.arange(4 * CELL) // side % 2)  # next to each other they cancel
    recent = 8 + spikes * sign * sign[:, None]
    moved = find_changes(recent, torch.full_like(recent, 160), 20 / 400)[0]
    assert moved.all()


def falloff(side=SIDE, width=20.0):
    y, x = torch.meshgrid(*2 * [torch.arange(side) - side / 3], indexing="ij")
    return 1 / (1 + (x.square() + y.square()) / width**2)


@pytest.mark.parametrize(("width", "gain"), [(20, 1.5), (40, 0.6), (1e6, 0.5), (1e6, 0.9), (1e6, 1.4)])
def test_a_lamp_that_changes_is_a_gain_of_what_it_lights(width, gain):
    light, lamp = 0.1 + 0.2 * torch.rand(SIDE, SIDE, generator=generator()), 1 + (gain - 1) * falloff(width=width)
    reference = counts(light, 60, 20)[1]
    moved, found, _ = find_changes(counts(lamp * light, 60, 20, 1)[0], reference, 20 / 60)
    assert not moved.any()
    assert (found / lamp - 1).square().mean() < 0.018**2


def test_a_bright_object_that_moves_is_no_lamp():
    light = torch.full((SIDE, SIDE), 0.01)
    light[:16] = 0.35 * (0.6 + 0.4 * torch.rand(16, SIDE, generator=generator(5)))
    reference, share = counts(light, 60, 20)[1], 20 / 60
    light[:16] = 1.02 * light[:16].roll(1, 1)
    moved, gain, _ = find_changes(counts(light, 60, 20, 1)[0], reference, share)
    assert moved[:2].all()
    assert not moved[2:].any()
    assert (gain == 1).all()


def calibrated():
    gain, dark, dead = torch.randn(3, SIDE, SIDE, generator=generator(2))
    return Calibration(1 + 0.06 * gain.clamp(-3, 3), 0.002 * (2 + dark.clamp(-2, 2)), 2 * (dead > 2.7).byte())


NOISE = SensorNoise(photons=3000, dark_current=0.0047, dark_spread=0.39, gain_spread=0.06)


class Sensor(CSCSR):
    """Enlarges the mean of its clip, and asks for a margin, but not for motion."""

    halo = 4

    def resolve_flow(self, *_):
        return None

    def forward(self, spikes, flow=None, static=False):
        seen = spikes.float().mean(1, keepdim=True).expand(-1, 1 if self.pattern == "grey" else 3, -1, -1) / 0.4
        return torch.nn.functional.interpolate(seen, scale_factor=self.scale, mode="bilinear")


def film(light, network=None, sensor=None, every=EVERY, **how):
    network = Sensor(**TINY) if network is None else network
    known = sensor if sensor is not NOISE else None
    noise = SensorNoise(photons=30_000, calibration=known) if known else sensor
    spikes = simulate_spikes(light, generator=generator(), noise=noise)[None]
    network.noise_level = float(sensor is NOISE)
    maker = FilmMaker(network, **how)
    maker.calibration = known
    for clock in range(20, light.shape[0] - 20, every):
        yield maker(spikes[:, clock - 20 : clock + 21], [clock])[0], maker.rest and maker.rest.computed


def moving(clocks, velocity=(0.3, 0.1)):
    return Scene([Layer(texture(2 * SIDE), Motion(velocity=velocity))], 2 * SIDE, 2 * SIDE, clocks).light(scale=2)


def still(clocks):
    return moving(1, (0.0, 0.0)).expand(clocks, -1, -1)


@pytest.mark.parametrize(("kind", "sensor"), [(CSCSR, None), (RecurrentCSCSR, None), (Sensor, calibrated())])
def test_a_scene_at_rest_asks_the_network_for_eight_pictures_and_no_more(kind, sensor):
    computed = [cells.all().item() for _, cells in film(still(321), kind(**TINY).eval(), sensor, psnr_tolerance=0.1)]
    assert all(computed[:8])
    assert not any(computed[11:])


@pytest.mark.parametrize("light", [0.11, 0.125])
def test_even_light_rests(light):
    pictures = film(torch.full((641, 2 * SIDE, 2 * SIDE), light), psnr_tolerance=0.1)
    computed = [cells.any().item() for _, cells in pictures]
    assert not any(computed[11:])


def test_where_everything_moves_pictures_equal_those_without_tolerance_until_it_stops():
    light, network = moving(141), CSCSR(**TINY).eval()
    light = torch.cat([light, light[-1:].expand(520, -1, -1)])
    pictures = list(film(light, network, psnr_tolerance=0.1))
    for (plain, _), (found, computed) in zip(film(light[:141], network), pictures[:6], strict=True):
        assert computed.all()
        assert found.equal(plain)
    assert not pictures[-1][1].any()


def test_motion_in_step_with_the_pictures_is_seen():
    clocks, columns = torch.arange(321.0)[:, None, None], torch.arange(SIDE)
    light = (0.2 + 0.1 * torch.sin((clocks + columns) * 2 * math.pi / EVERY)).expand(-1, SIDE, -1)
    assert all(cells.all() for _, cells in film(light, psnr_tolerance=0.1))


@pytest.mark.parametrize(("contrast", "speed"), [(0.05, 0.02), (0.1, 0.02), (0.05, 0.005)])
def test_a_wheel_of_low_contrast_does_not_rest(contrast, speed):
    y, x = torch.meshgrid(*2 * [torch.arange(SIDE) - SIDE / 2], indexing="ij")
    angle = torch.atan2(y, x) - speed * torch.arange(421)[:, None, None]
    wheel = 0.25 * (1 + contrast * torch.sin(6 * angle) * (x.square() + y.square() < 100))
    assert all(cells[3:5, 3:5].all() for _, cells in list(film(wheel, psnr_tolerance=0.1))[13:])


def flickering(clocks, depth, field=1.0):
    return 1 + depth * field * torch.sin(2 * math.pi * torch.arange(clocks) / 200)[:, None, None]


@pytest.mark.parametrize(("sensor", "depth"), [(None, 0), (calibrated(), 0), (None, 0.3)])
def test_a_small_object_leaves_most_of_the_scene_at_rest_also_under_a_lamp(sensor, depth):
    light = still(441).clone()
    for clock in range(441):
        light[clock, 24:32, 4 + clock // 10 : 12 + clock // 10] = 0.38
    light *= flickering(441, depth, falloff())
    for n, (_, cells) in enumerate(film(light, sensor=sensor, psnr_tolerance=0.1)):
        assert cells[3, (6 + 2 * n) // CELL : (12 + 2 * n) // CELL + 1].all()
        assert n < 12 or cells.float().mean() < 0.7


def test_a_dark_object_does_not_rest_while_it_moves():
    light = torch.full((601, SIDE, SIDE), 0.01)
    for clock in range(601):
        light[clock, 24:40, 4 + clock // 20 : 20 + clock // 20] = 0.016
    for n, (_, cells) in enumerate(film(light, psnr_tolerance=0.1)):
        assert cells[3:5, (5 + n) // CELL : (20 + n) // CELL + 1].all()


def test_what_has_little_contrast_does_not_rest_where_the_rest_of_a_scene_moves():
    light = moving(401, (0.05, 0.0)).clone()
    faint = light[..., : 6 * CELL]
    faint.sub_(faint.mean()).mul_(0.03).add_(0.2)
    assert all(cells.all() for _, cells in film(light, psnr_tolerance=0.1))


@pytest.mark.parametrize(
    ("contrast", "speed", "sensor", "share"),
    [(1.0, 1 / 300, None, 0.95), (0.08, 1 / 100, None, 0.85), (0.08, 1 / 100, NOISE, 0.85)],
)
def test_slow_drift_is_seen_before_it_is_half_a_pixel(contrast, speed, sensor, share):
    light = moving(441, (speed, 0.0))
    light = 0.2 + contrast * (light - light.mean())
    shares = [cells.float().mean().item() for _, cells in film(light.clamp(min=0), None, sensor, psnr_tolerance=0.1)]
    assert sum(shares[9:]) / len(shares[9:]) > share


def test_a_small_part_that_drifts_rests_only_until_that_is_seen():
    light, part = still(841).clone(), slice(26, 38)
    drift = moving(841, (0.001, 0.0))[:, part, part]
    light[:, part, part] = 0.2 + 0.5 * (drift - drift.mean())
    assert all(cells[3:5, 3:5].all() for _, cells in list(film(light, psnr_tolerance=0.1))[22:])


@pytest.mark.parametrize(("sensor", "every"), [(None, 6), (calibrated(), 20)])
def test_a_picture_at_rest_becomes_the_mean_of_all_clocks_since_it_changed(sensor, every):
    pattern = 0.3 + 0.1 * torch.rand(SIDE, SIDE, generator=generator())
    before, network = pattern.clone(), Sensor(**{**TINY, "scale": 1, "pattern": "grey"})
    before[:, :48] = pattern.mT[:, :48]
    light = torch.cat([before.expand(601, -1, -1), pattern.expand(401, -1, -1)])
    pictures = [rgb for rgb, _ in film(light, network, sensor, every, psnr_tolerance=0.1)]
    works = 1 if sensor is None else sensor.defects == 0
    first, last = ((works * (pictures[n] - pattern / 0.4))[..., :48].norm() for n in (624 // every, -1))
    assert last < first / 5


def test_a_hot_pixel_that_the_network_removes_does_not_return():
    class Clean(Sensor):
        def forward(self, *clip):
            return super().forward(*clip).clamp(max=0.6)

    light = torch.full((441, 16, 16), 0.2)
    light[:, 5, 5] = 1
    *_, (last, _) = film(light, Clean(**{**TINY, "scale": 1, "pattern": "grey"}), psnr_tolerance=0.1)
    assert last.max() < 0.65


@pytest.mark.parametrize(("more", "pixels", "within"), [(0.08, 3, 2), (0.003, 1, 14)])
def test_what_appears_is_seen_at_once_and_what_is_faint_in_time(more, pixels, within):
    before, network = 30, Sensor(**{**TINY, "scale": 1, "pattern": "grey"})
    light = torch.full((20 * (before + within) + 41, 32, 32), 0.4)
    light[20 * before + 41 :, 8:16:pixels, 8:16:pixels] += more
    cells = [computed for _, computed in film(light, network, psnr_tolerance=0.1)]
    assert not any(computed.any() for computed in cells[11 : before + 1])
    assert any(computed[1, 1] for computed in cells[before + 1 :])


@pytest.mark.parametrize("field", [1.0, falloff()])
@pytest.mark.parametrize(("sensor", "every"), [(None, 40), (calibrated(), 20), (NOISE, 20)])
def test_a_lamp_that_flickers_leaves_the_picture_at_rest_and_its_light_at_the_clock_is_shown(sensor, every, field):
    network = Sensor(**{**TINY, "scale": 1, "pattern": "grey"})
    light = 0.5 * flickering(1081, 0.3, field) * still(1081)
    found = list(film(light, network, sensor, every, psnr_tolerance=0.1))
    assert not found[-1][1].any()
    clocks = range(20 + every * (len(found) - 10), 1061, every)
    ratio = [rgb.mean() * 0.4 / light[clock].mean() for (rgb, _), clock in zip(found[-10:], clocks, strict=True)]
    assert max(ratio) < 1.025 * min(ratio)
    assert max(ratio) == pytest.approx(1, abs=0.03 + 0.0047 / light.mean().item() * (sensor is NOISE))


def test_a_lamp_that_goes_out_is_no_gain():
    light = torch.cat([0.5 * still(61), torch.zeros(84, SIDE, SIDE), 0.5 * still(601)])
    network = Sensor(**{**TINY, "scale": 1, "pattern": "grey"})
    pictures = (film(light, network, NOISE, psnr_tolerance=tolerance) for tolerance in (0.1, 0))
    for (found, _), (plain, _) in zip(*pictures, strict=True):
        assert (found - plain).square().mean() < 1e-3


@pytest.mark.parametrize(
    ("tolerance", "halo", "message"),
    [
        (-0.1, 4, "expected 0 dB or more, got -0.1"),
        (math.nan, 4, "expected 0 dB or more, got nan"),
        (0.1, None, "expected 0 for CSCSR, run on whole pictures only, got 0.1"),
    ],
)
def test_invalid_tolerances_are_rejected(tolerance, halo, message):
    network = CSCSR(**TINY)
    network.halo = halo
    with pytest.raises(ValueError, match=f"^psnr_tolerance: {message}$"):
        FilmMaker(network, psnr_tolerance=tolerance)


class Counted(Sensor):
    """Counts the pixels that it sees, estimates motion, and enlarges the mean of the frames in the middle."""

    seen, resolve_flow = 0, CSCSR.resolve_flow

    def forward(self, spikes, flow=None, static=False):
        self.seen += spikes[0, 0].numel()
        return super().forward(spikes[:, 12:-12])


def in_pairs(light, scale=2, **how):
    """Pictures at the size of the sensor, shares of pixels seen, and cells computed, of a grey film."""
    network = Counted(**{**TINY, "scale": scale, "pattern": "grey"})
    spikes, maker = simulate_spikes(light, generator=generator())[None], FilmMaker(network, **how)
    found, shares, cells = [], [], []
    groups = film_groups(range(20, len(light) - 20, EVERY), 1, maker.together(EVERY))
    for group in groups:
        network.seen = 0
        found += maker(torch.cat([spikes[:, at - 20 : at + 21] for at in group]), group)
        shares.append(network.seen / (len(group) * light[0].numel()))
        cells += maker.computed
    return torch.nn.functional.avg_pool2d(torch.stack(found), scale), shares, cells


def drifting(clocks, speed=0.02, scene=None):
    picture = texture(3 * SIDE)[:1] if scene is None else scene
    shown = (flow_warp(picture[None], torch.full((1, 2, *picture.shape[1:]), speed * n)) for n in range(clocks))
    return 0.4 * torch.cat([one[0, :, :SIDE, :SIDE] for one in shown])


def test_in_a_slow_scene_every_other_picture_is_interpolated_and_no_worse():
    light = drifting(201)
    plain, (found, shares, cells) = in_pairs(light)[0], in_pairs(light, psnr_tolerance=0.1)
    assert all(share == 0.5 for share in shares[1:-1])
    assert not any(one.any() for one in cells[1:-1:2])
    for n in range(1, len(found) - 1):
        errors = [(one[n] - light[20 + EVERY * n] / 0.4).square().mean() for one in (found, plain)]
        assert found[n].equal(plain[n]) if n % 2 == 0 else errors[0] < errors[1]


@pytest.mark.parametrize(("speed", "scale"), [(0.07, 2), (0.02, 1)])
def test_a_scene_that_is_too_fast_is_computed_and_any_at_x1(speed, scale):
    light = drifting(161, speed)
    found, shares, _ = in_pairs(light, scale, psnr_tolerance=0.1)
    assert shares[1] == 1
    assert found[1].equal(in_pairs(light, scale)[0][1])


def test_of_a_slow_scene_only_what_contradicts_it_is_computed(monkeypatch):
    monkeypatch.setattr(FilmMaker, "_fast", lambda *_: torch.zeros(8, 8, dtype=torch.bool))
    light = drifting(161)
    light[34:47, 26:31, 34:39] = 0.0
    plain, (found, shares, cells) = in_pairs(light)[0], in_pairs(light, psnr_tolerance=0.1)
    assert 0.5 < shares[1] < 0.8
    assert cells[1][3, 4]
    assert found[1][:, 26:31, 34:39].allclose(plain[1][:, 26:31, 34:39])


def test_spikes_contradict_a_picture_where_it_lacks_an_object_or_the_light_of_a_lamp_and_rarely_elsewhere():
    light = 0.4 * torch.rand(256, 256, generator=generator())
    off = [counts(light, 1, 21, seed)[0] - 21 * light for seed in (1, 2, 3)]
    assert not find_misfits(*off, 1.0).any()
    assert find_misfits(off[0] + 0.02 * 21 * light, *off[1:], 1.0).all()
    off[0][18:22, 34:38] += 2
    assert find_misfits(*off, 1.0).nonzero().tolist() == [[2, 4]]

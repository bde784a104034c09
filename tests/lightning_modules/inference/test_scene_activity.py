import pytest
import torch

from lightning_modules.inference.scene_activity import CELL, expected_errors, moving_cells, scene_activity
from lightning_modules.storage.error_model import ErrorModel
from spikekit import spike_integrate_fire
from spikekit.scenes.analytic import Layer, Motion, Scene
from spikekit.sensor.noise import SensorNoise
from spikekit.sensor.simulate import simulate_spikes


def noise(height, width, seed=0):
    return torch.rand(3, height, width, generator=torch.Generator().manual_seed(seed))


def clip(scene, scale=2, alpha=0.4, seed=0, sensor=None):
    generator = torch.Generator().manual_seed(seed)
    return simulate_spikes(scene.light("RGGB", scale=scale, alpha=alpha), noise=sensor, generator=generator)[None]


def grey(level, height=48, width=64, seed=0):
    return clip(Scene([Layer(torch.full((3, 2 * height, 2 * width), level))], 2 * height, 2 * width), seed=seed)


MODEL = ErrorModel(still=0.05, textured=1.5, moved=0.02, faint=1e-4)


def seen(spikes, alpha=0.4):
    return scene_activity(spikes, "RGGB", alpha)


def moving(spikes, tolerance, model=MODEL):
    return moving_cells(*expected_errors(seen(spikes), model), tolerance)


def test_a_still_clip_needs_no_motion_however_rich_it_is():
    picture = noise(96, 128).repeat_interleave(2, 1).repeat_interleave(2, 2)
    assert not moving(clip(Scene([Layer(picture)], 96, 128)), 0.05).any()


def test_what_moves_is_found_where_it_moves():
    ground = Layer(noise(192, 192).repeat_interleave(2, 1)[:, :192] * 0.8)
    thing = Layer(noise(32, 32, 1), Motion(velocity=(0.8, 0.0)), (96, 32), torch.ones(32, 32))
    rows, columns = moving(clip(Scene([ground, thing], 192, 192)), 0.05).nonzero().unbind(dim=1)
    assert set(rows.tolist()) == {1}  # the object passes sensor rows 16 to 32, columns 40 to 72
    assert {3} <= set(columns.tolist()) <= {2, 3, 4}


@pytest.mark.parametrize(("alpha", "black", "share"), [(0.4, 0, 1), (0.8, 0, 1), (0.4, 8, 0.863)])
def test_change_is_counted_in_parts_of_a_white_pixel_and_black_hides_little_of_it(alpha, black, share):
    """Light that grows steadily by a tenth of white, where it is not black, which has no noise."""
    ramp = alpha * (0.4 + torch.linspace(0, 0.1, 41)[:, None, None]).expand(41, 64, 64).clone()
    ramp.unflatten(-1, (4, 16))[..., :black] = 0
    charge = torch.rand(64, 64, generator=torch.Generator().manual_seed(0))
    change = seen(spike_integrate_fire(ramp, charge=charge)[0][None], alpha).change
    assert (change / (0.1**2 * CELL**2)).mean().item() == pytest.approx(share, abs=0.01 if black else 0.2)


def test_noise_of_a_real_sensor_asks_for_more_never_for_less():
    picture = noise(96, 128).repeat_interleave(2, 1).repeat_interleave(2, 2)
    scene = Scene([Layer(picture)], 96, 128)
    ideal, noisy = (seen(clip(scene, sensor=sensor)) for sensor in (None, SensorNoise(photons=20)))
    assert noisy.change.sum() > 2 * ideal.change.sum()
    assert noisy.texture.sum() > ideal.texture.sum()


def test_texture_is_found_where_it_is_in_any_colour():
    for colour in range(3):
        picture = torch.full((3, 128, 192), 0.5)
        picture[colour, 64:96, 32:64] = noise(32, 32)[0].mul(2).floor()
        texture = seen(clip(Scene([Layer(picture)], 128, 192))).texture[0]
        row, column = divmod(int(texture.argmax()), texture.shape[1])
        assert (row, column) == (2, 1)  # sensor rows 32 to 48, columns 16 to 32


def test_more_tolerance_never_asks_for_more_and_spends_what_it_may():
    ground = Layer(noise(96, 96).cumsum(2) / 96, Motion(velocity=(0.1, 0.0)))
    thing = Layer(noise(48, 48, 1), Motion(velocity=(0.4, 0.2)), (30, 30), torch.ones(48, 48))
    still, error = expected_errors(seen(clip(Scene([ground, thing], 96, 96))), MODEL)
    before = torch.ones(3, 3, dtype=torch.bool)
    for tolerance in (1e-6, 0.01, 0.05, 0.1, 0.3, 1, 3, 10, 100):
        motion = moving_cells(still, error, tolerance)
        assert (still[0] * ~motion).sum() <= (10 ** (tolerance / 10) - 1) * error.sum() * (1 + 1e-5)
        assert not (motion & ~before).any()
        before = motion
    assert not motion.any()


def test_cells_that_are_alike_are_left_out_together_or_not_at_all():
    """The budget would do for some of them."""
    ones = torch.ones(1, 3, 4)
    error = ones * 0.5 / (10**0.1 - 1)  # six of twelve at 1 dB
    assert moving_cells(ones, error, 1.0).all()
    assert not moving_cells(ones, error, 3.1).any()


def test_of_several_clips_the_most_demanding_decides():
    rich = clip(Scene([Layer(noise(96, 128), Motion(velocity=(0.3, 0.0)))], 96, 128))
    alone = moving(rich, 0.1)
    assert alone.any()
    assert moving(torch.cat([grey(0.5), rich]), 0.1).equal(alone)


@pytest.mark.parametrize("size", [(3, 3), (15, 33), (16, 16), (50, 70)])
def test_any_size_and_dtype(size):
    spikes = (torch.rand(2, 41, *size, generator=torch.Generator().manual_seed(0)) < 0.3).to(torch.uint8)
    found = scene_activity(spikes, "GBRG", 0.4)
    for part in found:
        assert part.shape == (2, *(-(-length // CELL) for length in size))
        assert part.isfinite().all()
    for other in (spikes.float(), spikes.bool()):
        assert scene_activity(other, "GBRG", 0.4).change.equal(found.change)
    with torch.autocast("cpu", torch.bfloat16):
        assert scene_activity(spikes, "GBRG", 0.4).change.equal(found.change)

from dataclasses import replace

import pytest
import torch

from lightning_modules.inference.scene_activity import CELL, look, required, scene_activity
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


MODEL = ErrorModel(flat=2.5, grainy=0.3, blurred=0.08, still=0.05, textured=1.5, moved=0.02, faint=1e-4)


def seen(spikes, alpha=0.4):
    return look(spikes, 2, "RGGB", alpha, MODEL)


@pytest.mark.parametrize("level", [0.0, 0.3, 0.5, 0.6, 1.0])
def test_a_plain_clip_needs_nothing(level):
    found = seen(grey(level))
    assert [cells.any().item() for cells in required(found, 0.1)] == [False, False]
    assert (found.picture - level).abs().max() < 0.03


def test_a_still_clip_needs_no_motion_however_rich_it_is():
    picture = noise(96, 128).repeat_interleave(2, 1).repeat_interleave(2, 2)
    network, motion = required(seen(clip(Scene([Layer(picture)], 96, 128))), 0.05)
    assert network.all()
    assert not motion.any()


def test_what_moves_is_found_where_it_moves():
    ground = Layer(noise(192, 192).repeat_interleave(2, 1)[:, :192] * 0.8)
    thing = Layer(noise(32, 32, 1), Motion(velocity=(0.8, 0.0)), (96, 32), torch.ones(32, 32))
    _, motion = required(seen(clip(Scene([ground, thing], 192, 192))), 0.05)
    rows, columns = motion.nonzero().unbind(dim=1)  # the object passes sensor rows 16 to 32, columns 40 to 72
    assert set(rows.tolist()) == {1}
    assert {3} <= set(columns.tolist()) <= {2, 3, 4}


def test_texture_is_found_where_it_is_in_any_colour():
    for colour in range(3):
        picture = torch.full((3, 128, 192), 0.5)
        picture[colour, 64:96, 32:64] = noise(32, 32)[0].mul(2).floor()
        network, _ = required(seen(clip(Scene([Layer(picture)], 128, 192))), 0.1)
        assert network[2, 1]  # sensor rows 32 to 48, columns 16 to 32
        network[1:4, 0:3] = False
        assert not network.any()


@pytest.mark.parametrize("level", [0.01, 0.02, 0.04])
def test_dark_parts_keep_the_network(level):
    """What is flat in the dark is grainy, and a network averages better than the smooth picture."""
    found = seen(grey(level, 96, 128))
    error = (found.picture - level).square().mean() * 96 * 128
    assert error / 2 < found.flat.sum() < 2 * error
    assert required(found, 0.1)[0].all()


def test_change_is_counted_in_parts_of_a_white_pixel():
    """Light that grows steadily by a tenth of white, and texture of a known size, whatever alpha is."""
    for alpha in (0.4, 0.8):
        ramp = alpha * (0.4 + torch.linspace(0, 0.1, 41)[:, None, None]).expand(41, 64, 64)
        charge = torch.rand(64, 64, generator=torch.Generator().manual_seed(0))
        spikes, _ = spike_integrate_fire(ramp, charge=charge)
        still = seen(spikes[None], alpha).still
        assert (still / (0.05 * 0.1**2 * CELL**2)).mean().item() == pytest.approx(1, abs=0.2)


def test_black_says_little_of_what_changes_beside_it():
    """Half of every cell is black, which has no noise, and the other half grows by a tenth of white."""
    ramp = 0.4 * (0.4 + torch.linspace(0, 0.1, 41)[:, None, None]).expand(41, 64, 64).clone()
    ramp.unflatten(-1, (4, 16))[..., :8] = 0
    charge = torch.rand(64, 64, generator=torch.Generator().manual_seed(0))
    change = scene_activity(spike_integrate_fire(ramp, charge=charge)[0][None], "RGGB", 0.4).change
    assert (change / (0.1**2 * CELL**2)).mean().item() == pytest.approx(0.863, abs=0.01)


def test_noise_of_a_real_sensor_asks_for_more_never_for_less():
    picture = noise(96, 128).repeat_interleave(2, 1).repeat_interleave(2, 2)
    scene = Scene([Layer(picture)], 96, 128)
    ideal, noisy = (seen(clip(scene, sensor=sensor)) for sensor in (None, SensorNoise(photons=20)))
    assert noisy.still.sum() > 2 * ideal.still.sum()
    assert noisy.flat.sum() > ideal.flat.sum()


def test_more_tolerance_never_asks_for_more_and_spends_what_it_may():
    ground = Layer(noise(96, 96).cumsum(2) / 96, Motion(velocity=(0.1, 0.0)))
    thing = Layer(noise(48, 48, 1), Motion(velocity=(0.4, 0.2)), (30, 30), torch.ones(48, 48))
    found = seen(clip(Scene([ground, thing], 96, 96)))
    before = None
    for tolerance in (1e-6, 0.01, 0.05, 0.1, 0.3, 1, 3, 10, 100):
        network, motion = required(found, tolerance)
        assert not (motion & ~network).any()
        spent = (found.flat[0] * ~network + found.still[0] * (network & ~motion)).sum()
        assert spent <= (10 ** (tolerance / 10) - 1) * found.error[0] * (1 + 1e-5)
        if before is not None:
            assert not (network & ~before[0]).any()
            assert not (motion & ~before[1]).any()
        before = network, motion
    assert not network.any()


def test_parts_that_are_alike_are_left_out_together_or_not_at_all():
    """The budget would do for some of them."""
    found = seen(grey(0.5))._replace(
        flat=torch.ones(1, 3, 4), still=torch.zeros(1, 3, 4), error=torch.tensor([6 / (10**0.1 - 1)])
    )
    assert required(found, 1.0)[0].all()
    assert not required(found, 3.1)[0].any()


def test_of_several_clips_the_most_demanding_decides():
    rich = clip(Scene([Layer(noise(96, 128), Motion(velocity=(0.3, 0.0)))], 96, 128))
    both = required(seen(torch.cat([grey(0.5), rich])), 0.1)
    for together, alone in zip(both, required(seen(rich), 0.1), strict=True):
        assert alone.any()
        assert together.equal(alone)


@pytest.mark.parametrize("size", [(3, 3), (15, 33), (16, 16), (50, 70)])
def test_any_size(size):
    spikes = (torch.rand(2, 41, *size, generator=torch.Generator().manual_seed(0)) < 0.3).to(torch.uint8)
    found = look(spikes, 3, "GBRG", 0.4)
    cells = tuple(-(-length // CELL) for length in size)
    assert found.picture.shape == (2, 3, 3 * size[0], 3 * size[1])
    assert found.flat.shape == found.still.shape == (2, *cells)
    assert all(part.isfinite().all() for part in found)
    assert (found.still <= found.flat).all()
    for other in (spikes.float(), spikes.bool()):
        assert look(other, 3, "GBRG", 0.4).flat.equal(found.flat)


def test_half_precision_around_it_changes_nothing():
    spikes = grey(0.5)
    with torch.autocast("cpu", torch.bfloat16):
        half = seen(spikes)
    assert half.flat.equal(seen(spikes).flat)
    assert half.picture.dtype == torch.float32


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_sees_the_same():
    spikes = clip(Scene([Layer(noise(96, 128), Motion(velocity=(0.3, 0.0)))], 96, 128))
    torch.testing.assert_close([*seen(spikes.cuda())], [*seen(spikes)], rtol=1e-3, atol=1e-4, check_device=False)


def test_constants_of_a_network_say_what_it_needs():
    """The same clip, and networks that lose more or less by the same."""
    picture = noise(96, 128).repeat_interleave(2, 1).repeat_interleave(2, 2)
    spikes = clip(Scene([Layer(picture, Motion(velocity=(0.2, 0.0)))], 96, 128))
    shares = []
    for factor in (0.01, 1.0, 100.0):
        model = replace(
            MODEL, **{name: factor * getattr(MODEL, name) for name in ("flat", "grainy", "blurred", "still")}
        )
        found = look(spikes, 2, "RGGB", 0.4, model)
        assert (found.still <= found.flat).all()
        shares.append([cells.double().mean().item() for cells in required(found, 0.5)])
    assert shares[0] == [0, 0]
    assert shares[2] == [1, 1]
    assert shares[1] not in (shares[0], shares[2])

"""Noise: each source follows its formula, and depends neither on chunks nor on other sources."""

import dataclasses
import itertools
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from spikekit.sensor.integrate_fire import spike_integrate_fire
from spikekit.sensor.noise import NoisyPixels, SensorNoise
from spikekit.sensor.simulate import SpikeSensor, simulate_spikes

EVERYTHING = SensorNoise(photons=30.0, dark_current=0.02, dark_spread=0.5, gain_spread=0.2, hot=0.05, dead=0.05)
ALONE = {
    "photons": SensorNoise(photons=30.0),
    "dark_current": SensorNoise(dark_current=0.02),
    "dark_spread": SensorNoise(dark_current=0.02, dark_spread=0.5),
    "dark_photons": SensorNoise(dark_current=0.02, photons=30.0),
    "gain_spread": SensorNoise(gain_spread=0.2),
    "hot": SensorNoise(hot=0.05),
    "dead": SensorNoise(dead=0.05),
}
NOISES = [*ALONE.values(), EVERYTHING]


def chance(seed=0):
    return torch.Generator().manual_seed(seed)


def arriving(noise, light, *, threshold=1.0, seed=0, clock=0):
    size = tuple(light.shape[:-3] + light.shape[-2:])
    return NoisyPixels(noise, size, seed).charge(light, threshold, clock)


def close(values, expected, deviation):
    """Return whether a mean is within five standard errors."""
    return abs(values.double().mean().item() - expected) < 5 * deviation / math.sqrt(values.numel())


# What happens without noise


def test_without_noise_light_and_spikes_are_unchanged():
    light = torch.rand(30, 9, 7)
    start = torch.rand(9, 7, generator=chance(3))
    expected, _ = spike_integrate_fire(light, charge=start)
    for noise in (None, SensorNoise()):
        spikes = simulate_spikes(light, noise=noise, generator=chance(3))
        assert spikes.dtype == torch.uint8
        assert torch.equal(spikes, expected.to(torch.uint8))
    assert arriving(SensorNoise(), light) is light
    assert 0 <= start.min() <= start.max() < 1


def test_initial_charge_does_not_depend_on_noise():
    dark = torch.zeros(1, 80, 80)
    for noise in (SensorNoise(), *NOISES):
        sensor = SpikeSensor(noise, threshold=2.0, seed=5)
        sensor.expose(dark)
        if noise == SensorNoise():
            begins = sensor.charge
            assert close(begins, 1.0, math.sqrt(1 / 3))
            assert close((begins - 1) ** 2, 1 / 3, math.sqrt(4 / 45))
            assert 0 <= begins.min() <= begins.max() < 2
        leaked = begins + arriving(noise, dark, threshold=2.0, seed=5)[0]
        torch.testing.assert_close(sensor.charge, leaked % 2)


# Each source


@pytest.mark.parametrize("threshold", [1.0, 2.5])
def test_photon_noise_has_poisson_mean_and_variance(threshold):
    light = torch.full((60, 50, 50), 0.3 * threshold)
    found = arriving(SensorNoise(photons=20.0), light, threshold=threshold).double() * 20 / threshold
    counts = found.round()
    torch.testing.assert_close(found, counts, atol=1e-4, rtol=0)  # whole photons
    mean = 20 * 0.3
    assert close(counts, mean, math.sqrt(mean))
    assert close((counts - mean) ** 2, mean, math.sqrt(mean + 2 * mean**2))
    assert close((counts[1:] - mean) * (counts[:-1] - mean), 0, mean)  # nothing comes back at the next clock
    assert close((counts == 2).double(), mean**2 / 2 * math.exp(-mean), 0.5)


@pytest.mark.parametrize("threshold", [1.0, 2.5])
def test_dark_current_adds_its_charge(threshold):
    noise = SensorNoise(dark_current=0.0125)
    spikes = simulate_spikes(torch.zeros(400, 20, 20), noise=noise, threshold=threshold)
    assert set(spikes.int().sum(0).unique().tolist()) <= {4, 5, 6}  # 400 * 0.0125, to a rounding of the charge
    assert abs(spikes.sum() / 400 - 5) < 0.1
    light = torch.rand(3, 4, 5)
    torch.testing.assert_close(arriving(noise, light, threshold=threshold), light + 0.0125 * threshold)


@pytest.mark.parametrize("spread", [0.05, 0.4, 2.0])
def test_fixed_pattern_has_the_given_spread_and_is_constant(spread):
    light = torch.full((3, 300, 300), 0.3)
    gain = arriving(SensorNoise(gain_spread=spread), light) / light
    dark = arriving(SensorNoise(dark_current=0.1, dark_spread=spread), light * 0) / 0.1
    for pixels in (gain, dark):
        assert torch.equal(pixels, pixels[:1].expand(3, -1, -1))
        values = pixels[0].double()
        assert values.min() > 0
        assert close(values, 1, spread)
        kurtosis = (1 + spread**2) ** 4 + 2 * (1 + spread**2) ** 3 + 3 * (1 + spread**2) ** 2 - 3  # of log-normal ones
        assert close((values - 1) ** 2, spread**2, spread**2 * math.sqrt(kurtosis - 1))
        logs = values.log()
        assert close(logs, -0.5 * math.log1p(spread**2), math.sqrt(math.log1p(spread**2)))
    correlation = torch.corrcoef(torch.stack([gain[0].flatten().log(), dark[0].flatten().log()]))[0, 1]
    assert abs(correlation) < 5 / 300  # one pixel's gain says nothing about its dark current


def test_hot_pixels_always_fire_and_dead_ones_never():
    light = torch.full((50, 200, 200), 0.3)
    clean = simulate_spikes(light, generator=chance()).bool()
    bits = simulate_spikes(light, noise=SensorNoise(hot=0.02, dead=0.05), generator=chance()).bool()
    always, never = bits.all(0), ~bits.any(0)
    assert close(always.double(), 0.02, math.sqrt(0.02))
    assert close(never.double(), 0.05, math.sqrt(0.05))
    good = ~always & ~never
    assert torch.equal(bits[:, good], clean[:, good])
    more = simulate_spikes(light, noise=SensorNoise(hot=0.5, dead=0.5), generator=chance()).bool()
    assert (more.all(0) | ~more.any(0)).all()
    assert more.all(0)[always].all()
    assert not more[:, never].any()
    assert simulate_spikes(light, noise=SensorNoise(dead=1.0)).sum() == 0
    assert simulate_spikes(light, noise=SensorNoise(hot=1.0)).all()


# Together


def test_sources_of_noise_are_independent():
    light, without = torch.rand(6, 40, 40), dict.fromkeys(("dark_current", "dark_spread", "gain_spread"), 0.0)
    photons = arriving(dataclasses.replace(EVERYTHING, **without), light)
    electrons = arriving(dataclasses.replace(EVERYTHING, gain_spread=0.0), light * 0)
    gain = arriving(ALONE["gain_spread"], light * 0 + 1)
    torch.testing.assert_close(arriving(EVERYTHING, light), photons * gain + electrons)
    torch.testing.assert_close(photons, arriving(ALONE["photons"], light), rtol=0, atol=0)
    dark = arriving(ALONE["dark_spread"], light * 0)
    torch.testing.assert_close(arriving(dataclasses.replace(EVERYTHING, photons=None), light), light * gain + dark)
    many = arriving(dataclasses.replace(EVERYTHING, photons=1e9), light * 0)  # so many that the mean shows
    torch.testing.assert_close(many, dark, rtol=0.01, atol=0)
    good = dataclasses.replace(EVERYTHING, hot=0.0, dead=0.0)
    hot = simulate_spikes(light * 0, noise=ALONE["hot"], generator=chance())[0].bool()
    dead = ~simulate_spikes(light * 0 + 1, noise=ALONE["dead"], generator=chance())[0].bool()
    expected = (simulate_spikes(light, noise=good, generator=chance()).bool() | hot) & ~dead
    assert torch.equal(simulate_spikes(light, noise=EVERYTHING, generator=chance()).bool(), expected)


@given(
    noise=st.sampled_from(NOISES),
    cuts=st.sets(st.integers(1, 23), max_size=5),
    threshold=st.sampled_from([1.0, 0.7]),
    dtype=st.sampled_from([torch.float32, torch.float64, torch.float16]),
)
def test_chunks_equal_one_run(noise, cuts, threshold, dtype):
    light = torch.rand(24, 5, 6, generator=chance(2)).to(dtype) * threshold
    settings = {"threshold": threshold, "seed": 7}
    whole = SpikeSensor(noise, **settings)
    expected = whole.expose(light)
    edges = [0, *sorted(cuts), 24]
    sensor = SpikeSensor(noise, **settings)
    parts = []
    for start, stop in itertools.pairwise(edges):
        parts.append(sensor.expose(light[start:stop]))
    assert torch.equal(torch.cat(parts), expected)
    assert torch.equal(sensor.charge, whole.charge)
    assert sensor.clock == 24
    assert expected.shape == (24, 5, 6)


def test_seeds_repeat_and_differ():
    light, empty = torch.rand(20, 30, 30), torch.zeros(1, 1)
    for noise in NOISES:
        by_seed = [SpikeSensor(noise, seed=seed, charge=empty).expose(light) for seed in (1, 1, 2)]
        by_generator = [simulate_spikes(light, noise=noise, charge=empty, generator=chance(s)) for s in (1, 1, 2)]
        for first, same, other in (by_seed, by_generator):
            assert torch.equal(first, same)
            assert torch.equal(first, other) == (noise == ALONE["dark_current"])  # the one without chance


# What it changes


@pytest.mark.parametrize("light", [0.03, 0.5, 0.9])
@pytest.mark.parametrize(
    ("source", "noise", "reached"),
    [
        ("photons", SensorNoise(photons=3000.0), 0.9),
        ("photons", SensorNoise(photons=100.0), 0.2),
        ("dark_current", SensorNoise(dark_current=0.0004), 0.9),
        ("dark_current", SensorNoise(dark_current=0.0004, dark_spread=0.4, photons=50.0), 0.6),
        ("gain_spread", SensorNoise(gain_spread=0.001), 0.9),
        ("gain_spread", SensorNoise(gain_spread=0.1), 0.15),
        ("hot", SensorNoise(hot=0.2), 0.9),
        ("dead", SensorNoise(dead=0.2), 0.9),
    ],
)
def test_predicted_changes_bound_simulated_ones(source, noise, reached, light):
    rest = SensorNoise(photons=noise.photons if source != "photons" else None)
    for frames, pixels in ((2, 400), (41, 200)):
        lights = torch.full((frames, pixels, pixels), light)
        sensors = [SpikeSensor(n, seed=3) for n in (noise, rest)]
        noisy, clean = (sensor.expose(lights) for sensor in sensors)
        differ = (noisy != clean).double().mean()
        change = noise.spike_changes(light, frames)[source]
        slack = 5 * math.sqrt(change.share) / pixels  # bits of one pixel hang together
        assert reached * change.share - slack < differ < change.share + slack
        if source in ("hot", "dead") or light == 0.9:
            continue  # thresholds are lost in the read-out
        counts, left = noisy.sum(0, dtype=torch.double) - clean.sum(0), sensors[0].charge - sensors[1].charge
        assert (counts + left).abs().mean() == pytest.approx(change.charge, rel=0.04, abs=1e-5)


def test_only_required_sources_are_kept():
    for light in (0.0, 0.02, 0.4):
        changes = EVERYTHING.spike_changes(light, 41)
        assert list(changes) == ["photons", "dark_current", "gain_spread", "hot", "dead"]
        for tolerance in (0.0, *(change.share for change in changes.values())):
            left = EVERYTHING.required(light, 41, tolerance)
            expected = {source for source, change in changes.items() if change.share > tolerance}
            assert set(left.spike_changes(light, 41)) == expected
            assert (left.dark_spread == EVERYTHING.dark_spread) == bool(left.dark_current)
    assert set(EVERYTHING.required(0.0, 41, 0.0).spike_changes(0.0, 41)) == {
        "dark_current",
        "hot",
    }  # none is seen in the dark
    assert SensorNoise().spike_changes(0.3, 41) == {}


# Awkward input


def test_negative_and_infinite_light_is_unchanged():
    light = torch.tensor([-0.25, math.nan, math.inf, -math.inf, 1e30, 0.5]).reshape(1, 1, 6)
    noisy = arriving(SensorNoise(photons=10.0), light)
    torch.testing.assert_close(noisy[..., :5], light[..., :5], rtol=0, atol=0, equal_nan=True)
    assert noisy[..., 5].item() * 10 == pytest.approx(round(noisy[..., 5].item() * 10))
    assert torch.equal(light[..., 5], torch.full((1, 1), 0.5))  # nothing written into what came


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"photons": 0.99}, "photons: expected a finite number, 1 or more, got 0.99"),
        ({"dark_current": -0.1}, "dark_current: expected 0 to 1, got -0.1"),
        ({"dark_spread": 0.1}, "dark_spread: expected a dark_current above 0"),
        ({"gain_spread": 1e200}, r"gain_spread: expected 0 to 10, got 1e\+200"),
        ({"dead": math.nan}, "dead: expected 0 to 1, got nan"),
        ({"hot": 0.6, "dead": 0.5}, "hot, dead: expected shares that add up to at most 1, got 0.6, 0.5"),
    ],
)
def test_invalid_noise_is_rejected(settings, message):
    with pytest.raises(ValueError, match=message):
        SensorNoise(**settings)


def test_errors_say_what_was_expected():
    light = torch.rand(6, 4, 5)
    for make, message in (
        (lambda: SpikeSensor(seed=-1), "seed: expected 0 or more, got -1"),
        (lambda: simulate_spikes(light, charge=torch.zeros(3, 5)), r"charge: expected \(4, 5\), got \(3, 5\)"),
        (lambda: SensorNoise().spike_changes(-0.1, 41), "light: expected a finite number, 0 or more, got -0.1"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
    sensor = SpikeSensor(EVERYTHING)
    sensor.expose(light)
    with pytest.raises(ValueError, match=r"light: expected the size \(4, 5\) as before, got \(4, 6\)"):
        sensor.expose(torch.rand(6, 4, 6))

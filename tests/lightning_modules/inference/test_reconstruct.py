"""Reconstruction of recordings from Python: the chosen weights and the pictures."""

from itertools import islice

import pytest
import torch

from lightning_modules import reconstruct
from lightning_modules.inference.film import FilmMaker, film
from lightning_modules.networks import CSCSR, ClassicalDecoder, RecurrentCSCSR
from lightning_modules.registry import find_model
from spikekit import SensorNoise, SpikeSensor, mosaic, read_spikes, simulate_spikes, write_picture, write_spikes
from spikekit.calibration import Calibration, write_calibration
from spikekit.cli.command import main as spikekit_main

EXACT = {"precision": "32-true"}  # whatever the processor would do
TINY = {"scale": 2, "width": 8, "representation_width": 8, "features": 1, "stages": 1, "end_blocks": 1}


@pytest.fixture(name="recording")
def _recording(tmp_path):
    """A recording of 99 frames of noise."""
    write_spikes(tmp_path / "clip.npz", torch.rand(99, 12, 16, generator=torch.Generator().manual_seed(0)) < 0.3)
    return tmp_path / "clip.npz"


@pytest.fixture(name="flat")
def _flat(tmp_path):
    """Writes an ideal recording of 200 frames of a grey wall, of which a white pixel fires so often."""

    def write(white):
        light = torch.full((200, 8, 8), white)
        write_spikes(tmp_path / "flat.npz", simulate_spikes(light, generator=torch.Generator().manual_seed(0)))
        return tmp_path / "flat.npz"

    return write


def test_pictures_as_iterator_and_array(recording):
    pictures = reconstruct(recording, network=ClassicalDecoder("tfi", scale=2), white=0.4)
    clocks, rgb = zip(*pictures, strict=True)
    assert clocks == (20, 40, 60)
    assert len(pictures) == 3
    array = pictures.array()
    assert array.shape == (3, 24, 32, 3)
    assert array.dtype == "uint8"
    for shown, picture in zip(array, rgb, strict=True):
        assert abs(shown / 255 - picture.movedim(0, -1).numpy()).max() <= 0.51 / 255


@pytest.mark.parametrize("trained", ["RGGB", "GBRG"])
def test_colours_of_calibrated_sensors_are_correct_for_every_bayer_phase(tmp_path, trained):
    colour = torch.tensor([0.9, 0.5, 0.3])
    light = 0.4 * mosaic(colour[:, None, None].expand(41, 3, 16, 20), "BGGR")
    gain, dead = torch.linspace(0.6, 0.8, 20).repeat(16, 1), torch.zeros(16, 20, dtype=torch.uint8)
    dead[::5, ::3] = 1
    noise = SensorNoise(calibration=Calibration(gain, 0 * gain, dead))
    write_calibration(tmp_path / "flat.calibration.safetensors", noise.calibration)
    write_spikes(tmp_path / "flat.npz", simulate_spikes(light, generator=torch.Generator().manual_seed(0), noise=noise))
    network = ClassicalDecoder(scale=2, pattern=trained)
    ((_, rgb),) = reconstruct(tmp_path / "flat.npz", network=network, pattern="BGGR", white=0.4).pictures(beside="tfi")
    for half in (rgb[..., :36], rgb[..., -36:]):
        torch.testing.assert_close(half.mean(dim=(1, 2)), colour, rtol=0, atol=0.04)


def test_dim_recordings_give_bright_pictures(tmp_path):
    light = torch.linspace(0, 0.02, 400).reshape(20, 20).expand(121, 20, 20)
    write_spikes(tmp_path / "dim.npz", simulate_spikes(light, generator=torch.Generator().manual_seed(0)))
    network = ClassicalDecoder("tfp")
    for _, rgb in reconstruct(tmp_path / "dim.npz", network=network, frame="40:81:40"):
        assert rgb.quantile(0.999) > 0.9
    ((_, rgb),) = reconstruct(tmp_path / "dim.npz", network=network, frame="40", white=0.4)
    assert rgb.max() < 0.2


def test_uncalibrated_sensors_get_weights_for_noise(flat):
    pictures = reconstruct(flat(0.4), "fast")
    assert find_model(pictures.notes[0].split(",")[0].split(":")[0]).noise
    assert "this sensor is not calibrated" in pictures.notes[-1]
    assert "noise level 1.0 is assumed" in pictures.notes[-1]  # the pictures are too small


@pytest.mark.parametrize(("spread", "level"), [(0.0, 0.0), (0.06, 1.0)])
def test_noise_is_measured_if_nothing_is_known(tmp_path, spread, level):
    light = torch.linspace(0.1, 0.4, 64).expand(300, 48, 64)
    noise = SensorNoise(gain_spread=spread, hot=0.005, dead=0.005)
    write_spikes(tmp_path / "clip.npz", SpikeSensor(noise, seed=0).expose(light))
    made = reconstruct(tmp_path / "clip.npz", "fast", pattern="grey", frame="150")
    assert made.network.noise_level == pytest.approx(level, abs=0.2)
    assert any(" is measured: using weights trained for noisy" in note for note in made.notes) == (level > 0)
    ideal = reconstruct(tmp_path / "clip.npz", "fast", pattern="grey", calibration="none")
    assert ideal.network.noise_level == 0
    assert made.identity() != ideal.identity()  # a stopped run is not continued with the other
    assert 0.4 < made.white == ideal.white < 0.5  # not that of hot pixels
    rates = [next(one.clips.in_order())[1].float().mean(0) for one in (made, ideal)]
    assert rates[1].aminmax() == (0, 1)
    assert 0 < rates[0].min() < rates[0].max() < 0.6  # defects are filled, unless the sensor is declared ideal


def test_ideal_sensors_get_weights_for_ideal_sensors(flat, tmp_path, monkeypatch):
    asked = reconstruct(flat(0.4), "balanced", calibration="none")
    assert not find_model(asked.notes[0].split(",")[0].split(":")[0]).noise
    monkeypatch.chdir(tmp_path)
    write_picture("photo.png", torch.ones(3, 30, 40))
    spikekit_main(["simulate", "photo.png", "-o", "a.dat", "--scale", "1"])
    simulated = reconstruct("a.dat", "balanced")
    assert not find_model(simulated.notes[0].split(",")[0].split(":")[0]).noise


@pytest.mark.parametrize(
    ("white", "frame", "joined", "longer"),
    [(0.05, "100", 3, 4), (0.05, None, 2, 2), (0.05, "::30", 2, 2), (0.1, "30:", 1, 1), (0.4, "100", 1, 1)],
)
@pytest.mark.parametrize("speed", ["fastest", "fast"])
def test_dim_light_joins_frames_if_there_is_room(flat, speed, white, frame, joined, longer):
    """The brightness of the pictures stays the same. Decoders take longer clips instead."""
    pictures = reconstruct(flat(white / 2), speed, pattern="grey", frame=frame, white=white)
    clips = pictures.clips
    assert (clips.joined, clips.frames) == ((1, 41 * longer) if speed == "fastest" else (joined, 41 * joined))
    assert any("spike frames are joined" in line for line in pictures.notes) == (clips.joined > 1)
    for _, rgb in pictures:
        assert rgb.mean().item() == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(
    ("wrong", "error", "said"),
    [
        ({"white": 0}, ValueError, "white: expected a finite number above 0, got 0"),
        ({"white": float("nan")}, ValueError, "white: expected a finite number above 0, got nan"),
        ({"scale": 0}, ValueError, "scale: expected one that was measured .*, got 0"),
        ({"speed": None, "network": "cscsr_micro_x4", "scale": 2}, ValueError, "scale: expected 4, .* network, got 2"),
        ({"tile": -1}, ValueError, "tile: expected 0 pixels or more, got -1"),
        ({"device": "nowhere"}, ValueError, "device: expected one of this machine, got nowhere"),
        ({"psnr_tolerence": 0}, TypeError, "psnr_tolerence"),
    ],
)
def test_invalid_arguments_are_rejected_at_once(flat, wrong, error, said):
    with pytest.raises(error, match=said):
        reconstruct(flat(0.3), **{"speed": "fast", **wrong})


@pytest.mark.parametrize(("every", "size"), [(1, 12), (3, 4), (20, 2), (21, 1)])
def test_close_pictures_are_made_together(flat, every, size):
    pictures = reconstruct(flat(0.3), "balanced", frame=f"60:120:{every}", calibration="none")
    sizes = [len(group) for group, _ in pictures._groups(FilmMaker(pictures.network, **pictures.how), set(), 0, 1)]
    assert sizes[:3] == [1, size, size][: len(sizes)]
    assert FilmMaker(pictures.network).together(every) == 1
    assert FilmMaker(ClassicalDecoder(), psnr_tolerance=0.1).together(every) == 1


@pytest.mark.parametrize(
    ("speed", "how", "tolerance"),
    [("fast", {}, 0.1), ("balanced", {"psnr_tolerance": 0}, 0), ("balanced", {"future": 1}, 0), ("best", {}, 0)],
)
def test_films_of_fast_and_balanced_compute_only_what_moves(flat, speed, how, tolerance):
    pictures = reconstruct(flat(0.3), speed, calibration="none", **how)
    assert pictures.how.get("psnr_tolerance", 0) == tolerance


def test_recording_equals_stream_and_its_parts(recording):
    network = RecurrentCSCSR(**TINY).eval()
    for weight in (network.fusion.share.weight, network.fusion.rest.weight):
        torch.nn.init.normal_(weight, std=0.05)
    pictures = reconstruct(recording, network=network, frame="20:79:10", white=0.3, future=3, **EXACT)
    unbroken = dict(pictures)
    shown = dict(film(network, [read_spikes(recording)], 10, future=3, white=0.3))
    assert unbroken.keys() == shown.keys()
    for clock, rgb in shown.items():
        torch.testing.assert_close(unbroken[clock], rgb)
    parts = [dict(pictures.pictures(part=(n, 2))) for n in range(2)]
    again = dict(pictures.pictures(made=[20, 30, 50, 60]))
    assert again.keys() == {40, 70}
    for found in (*parts, again):
        assert all(torch.allclose(rgb, unbroken[clock]) for clock, rgb in found.items())
    assert [*parts[0], *parts[1]] == [*unbroken]


@pytest.mark.parametrize("kind", [CSCSR, RecurrentCSCSR])
def test_resumed_film_equals_the_unbroken_one_where_it_moves_and_where_it_rests(tmp_path, kind):
    random = torch.Generator().manual_seed(0)
    light = torch.rand(24, 32, generator=random).mul(0.4).repeat(461, 1, 1)
    light[:, :8] = torch.stack([light[0, :8].roll(clock // 10, 1) for clock in range(461)])
    write_spikes(tmp_path / "film.npz", simulate_spikes(light, generator=random))
    how = {"network": kind(**TINY, pattern="grey").eval(), "pattern": "grey", "white": 0.4, **EXACT}
    pictures, state = reconstruct(tmp_path / "film.npz", psnr_tolerance=0.1, **how), tmp_path / "state"
    unbroken = dict(pictures)
    stopped = dict(islice(pictures.pictures(state=state), 17))
    again = dict(pictures.pictures(made=[*stopped], state=state))
    assert [*again] == [*unbroken][17:]
    assert all(rgb.equal(unbroken[clock]) for clock, rgb in again.items())
    state.write_bytes(b"PK")  # damaged
    assert [*dict(pictures.pictures(made=[*stopped], state=state))] == [*again]


def test_self_ensemble_reaches_the_network(recording):
    network = CSCSR(**TINY).eval()
    ((_, plain),) = reconstruct(recording, network=network, frame="40", white=0.3)
    ((_, mean),) = reconstruct(recording, network=network, frame="40", white=0.3, self_ensemble=2)
    assert not torch.allclose(plain, mean)

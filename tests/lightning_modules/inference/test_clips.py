import pytest
import torch

from lightning_modules.inference.clips import RecordingClips
from spikekit import Calibration, SensorNoise, SpikeSensor, bayer_mask, write_calibration, write_picture, write_spikes
from spikekit.cli.command import main as spikekit_main
from spikekit.recording import open_recording

PATTERNS = ["RGGB", "BGGR", "GRBG", "GBRG"]


@pytest.fixture(name="spikes")
def _spikes():
    return (torch.rand(70, 6, 10) < 0.3).to(torch.uint8)


@pytest.fixture(name="opened")
def _opened(tmp_path):
    """A recording of spikes, written and opened."""

    def opened(spikes, name="clip.npz", flip=False, **known):
        write_spikes(tmp_path / name, spikes, flip=flip)
        size = {"height": spikes.shape[1], "width": spikes.shape[2]} if name.endswith(".dat") else {}
        return open_recording(tmp_path / name, **size, flip=flip, **known)

    return opened


@pytest.mark.parametrize("name", ["clip.dat", "clip.npz"])
def test_clips_equal_the_frames_of_the_file(opened, spikes, name):
    clips = RecordingClips(opened(spikes, name))
    assert clips.chosen == [20, 40]
    for frame, clip in clips.in_order():
        assert clip.equal(spikes[frame - 20 : frame + 21])


@pytest.mark.parametrize(
    ("name", "frame", "white", "joined", "first"),
    [("clip.dat", None, 0.002, 7, 17), ("clip.npz", "31:39:3", 0.002, 12, 31), ("clip.npz", None, 0.02, 5, 12)],
)
def test_joined_frames_have_the_spikes_of_their_frames(opened, spikes, name, frame, white, joined, first):
    clips = RecordingClips(opened(spikes, name), 5, frame).in_light(white)
    assert (clips.joined, clips.chosen[0]) == (joined, first)
    for middle, clip in clips.in_order():
        start = middle - 5 * joined // 2
        assert clip.equal(torch.stack([spikes[start + n * joined :][:joined].amax(0) for n in range(5)]))


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("crop_to", PATTERNS)
def test_clips_are_cropped_to_the_phase_of_the_network(opened, pattern, crop_to):
    red = bayer_mask(6, 10, pattern, dtype=torch.uint8)[0]
    clips = RecordingClips(opened(red.expand(41, 6, 10), pattern=pattern), crop_to=crop_to)
    ((_, clip),) = clips.in_order()
    assert {6 - clips.size[0], 10 - clips.size[1]} <= {0, 1}
    assert clip.equal(bayer_mask(*clips.size, crop_to, dtype=torch.uint8)[0].expand(41, -1, -1))


def test_grey_recordings_are_not_cropped(opened, spikes, tmp_path):
    grey = opened(spikes, pattern="grey")
    assert next(RecordingClips(grey, crop_to="BGGR").in_order())[1].equal(spikes[:41])
    write_spikes(tmp_path / "a.dat", torch.zeros(41, 250, 400, dtype=torch.uint8))
    assert RecordingClips(open_recording(tmp_path / "a.dat", camera="vidar"), crop_to="BGGR").size == (250, 400)


def test_too_small_recordings_are_rejected(opened, spikes):
    tiny = torch.zeros(41, 3, 5, dtype=torch.uint8)
    RecordingClips(opened(tiny))
    with pytest.raises(ValueError, match=r"clip.npz: expected at least 3 x 3 pixels .* got \(2, 4\)"):
        RecordingClips(opened(tiny, pattern="BGGR"))
    with pytest.raises(ValueError, match=r"clip.npz: expected at least 41 frames for a clip, got 40"):
        RecordingClips(opened(spikes[:40]))


@pytest.mark.parametrize(
    ("frame", "expected"), [("30", [30]), ("22:40:6", [22, 28, 34]), ("25:", [25, 45]), (":41", [20, 40])]
)
def test_key_frames_are_parsed(opened, spikes, frame, expected):
    clips = RecordingClips(opened(spikes), frame=frame)
    assert [middle for middle, _ in clips.in_order()] == expected


@pytest.mark.parametrize("frame", ["19", "50", "19:30", "20:51", "40:30", "x"])
def test_key_frames_without_a_whole_clip_are_rejected(opened, spikes, frame):
    with pytest.raises(ValueError, match=f"frame: expected .* got {frame}; a clip has 41 frames of the 70 of"):
        RecordingClips(opened(spikes), frame=frame)


def test_white_level_is_the_highest_at_any_time_and_does_not_depend_on_key_frames(opened):
    spikes = torch.zeros(2041, 8, 10, dtype=torch.uint8)
    spikes[1000::2, 2, 3] = 1  # bright half of the time; an eightieth of the pixels is more than a thousandth
    spikes[::4, 4:] = 1
    recording = opened(spikes)
    assert RecordingClips(recording, frame="20:60:20").white == RecordingClips(recording).white
    assert RecordingClips(recording).white == pytest.approx(0.48, abs=0.03)


def test_sidecar_gives_size_phase_and_white_level(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_picture("photo.png", torch.ones(3, 30, 40))
    simulate = ["simulate", "photo.png", "-o", "a.dat", "--scale", "1", "--pattern", "GBRG", "--alpha", "0.3"]
    assert spikekit_main(simulate) == 0
    clips = RecordingClips(open_recording("a.dat"))
    assert (clips.size, clips.recording.pattern, clips.white) == ((29, 40), "GBRG", 0.3)


@pytest.mark.parametrize("name", ["clip.dat", "clip.npz"])
@pytest.mark.parametrize("frame", ["20:50:1", "21:50:28"])
def test_frames_are_read_once_and_only_if_needed(opened, spikes, name, frame, monkeypatch):
    clips = RecordingClips(opened(spikes, name, pattern="BGGR"), 5, frame)
    read, frames_from = [], type(clips.recording).frames_from

    def counted(recording, start):
        for n, plane in enumerate(frames_from(recording, start), start):
            read.append(n)
            yield plane

    monkeypatch.setattr(type(clips.recording), "frames_from", counted)
    for middle, clip in clips.in_order():
        assert clip.equal(spikes[middle - 2 : middle + 3, 1:, 1:])
    assert read == sorted(set(read))
    if name == "clip.dat" and frame == "21:50:28":
        assert read == [*range(19, 24), *range(47, 52)]


def test_calibration_corrects_spikes(opened, tmp_path):
    defects = torch.zeros(6, 10, dtype=torch.uint8)
    defects[3, 4] = 2
    gain = torch.linspace(0.5, 1.5, 10).repeat(6, 1)
    sensor = Calibration(gain, torch.zeros(6, 10), defects)
    spikes = SpikeSensor(SensorNoise(calibration=sensor)).expose(torch.full((41, 6, 10), 0.2))
    write_calibration(tmp_path / "clip.calibration.safetensors", sensor)
    corrected = RecordingClips(opened(spikes))
    ((_, after),), ((_, before),) = corrected.in_order(), corrected.in_order(raw=True)
    assert before.equal(spikes)
    assert (after.sum(0) - 41 * 0.2).abs().max() < 2
    assert corrected.white < 0.3


def test_noise_of_short_dim_recordings_is_measured(opened):
    light = torch.linspace(0.04, 0.08, 64).expand(400, 64, 64)
    clips = RecordingClips(opened(SpikeSensor(SensorNoise(gain_spread=0.03), seed=0).expose(light), pattern="grey"))
    assert 0.2 < clips.noise_level < 0.6

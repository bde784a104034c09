import pytest
import torch

from lightning_modules.__main__ import main
from lightning_modules.data import Recording, RecordingClips
from lightning_modules.data.clips_around import film_groups
from lightning_modules.data.recording import _Batches
from spikekit import (
    Calibration,
    SensorNoise,
    SpikeFileError,
    SpikeSensor,
    bayer_mask,
    mosaic,
    read_picture,
    simulate_spikes,
    split_bayer,
    write_calibration,
    write_picture,
    write_spikes,
)
from spikekit.cli.command import main as spikekit_main

PATTERNS = ["RGGB", "BGGR", "GRBG", "GBRG"]


@pytest.fixture
def spikes():
    return (torch.rand(70, 6, 10) < 0.3).to(torch.uint8)


@pytest.mark.parametrize("name", ["clip.dat", "clip.npz"])
def test_clips_are_those_of_the_file(tmp_path, spikes, name):
    write_spikes(tmp_path / name, spikes)
    data = Recording(str(tmp_path / name), 6, 10, every=10)
    data.setup("predict")
    batches = list(data.predict_dataloader())
    assert [batch["frame"].item() for batch in batches] == [20, 30, 40]
    for batch in batches:
        frame = batch["frame"].item()
        assert batch["spikes"].equal(spikes[None, frame - 20 : frame + 21])


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("flip", [False, True])
def test_every_phase_becomes_rggb(tmp_path, spikes, pattern, flip):
    write_spikes(tmp_path / "clip.dat", spikes, flip=flip)
    (clip,) = RecordingClips(str(tmp_path / "clip.dat"), 6, 10, flip, pattern, every=60)
    red = split_bayer(spikes, pattern)[0][:41]
    found = clip["spikes"][:, ::2, ::2]
    assert found.equal(red[:, : found.shape[1], : found.shape[2]])


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("crop_to", PATTERNS)
def test_every_phase_becomes_that_of_the_network(tmp_path, pattern, crop_to):
    red = bayer_mask(6, 10, pattern, dtype=torch.uint8)[0]
    write_spikes(tmp_path / "red.npz", red.expand(41, 6, 10))
    (clip,) = RecordingClips(str(tmp_path / "red.npz"), pattern=pattern, crop_to=crop_to)
    height, width = clip["spikes"].shape[-2:]
    assert {6 - height, 10 - width} <= {0, 1}
    assert clip["spikes"].equal(bayer_mask(height, width, crop_to, dtype=torch.uint8)[0].expand(41, -1, -1))


@pytest.mark.parametrize("trained", ["RGGB", "GBRG"])
def test_predict_gives_the_colours_of_the_scene_whatever_phase_the_network_wants(tmp_path, monkeypatch, trained):
    colour = torch.tensor([0.9, 0.3, 0.1])
    light = 0.4 * mosaic(colour[:, None, None].expand(41, 3, 16, 20), "BGGR")
    write_spikes(tmp_path / "flat.npz", simulate_spikes(light, generator=torch.Generator().manual_seed(0)))
    network = ["--model.network", "ClassicalDecoder", "--model.network.scale", "2", "--model.network.pattern", trained]
    data = ["--data", "Recording", "--data.path", str(tmp_path / "flat.npz"), "--data.pattern", "BGGR"]
    data += ["--data.white", "0.4"]
    monkeypatch.setattr("sys.argv", ["lightning", "predict", *network, *data, "-o", str(tmp_path / "out")])
    main()
    (path,) = (tmp_path / "out").rglob("*.png")
    torch.testing.assert_close(read_picture(path).mean(dim=(1, 2)), colour, rtol=0, atol=0.04)


def test_a_recording_of_which_too_little_is_left_is_refused(tmp_path):
    write_spikes(tmp_path / "tiny.npz", torch.zeros(41, 3, 5, dtype=torch.uint8))
    RecordingClips(str(tmp_path / "tiny.npz"))
    with pytest.raises(
        ValueError, match=r"tiny.npz: expected at least 3 x 3 pixels that begin with RGGB, got \(2, 4\)"
    ):
        RecordingClips(str(tmp_path / "tiny.npz"), pattern="BGGR")


@pytest.mark.parametrize(
    ("frame", "expected"), [("30", [30]), ("22:40:6", [22, 28, 34]), ("25:", [25, 35, 45]), (":40", [20, 30])]
)
def test_frames_are_chosen(tmp_path, spikes, frame, expected):
    write_spikes(tmp_path / "clip.npz", spikes)
    clips = RecordingClips(str(tmp_path / "clip.npz"), every=10, frame=frame)
    assert [clip["frame"] for clip in clips] == expected
    assert clips[0]["spikes"].equal(spikes[expected[0] - 20 : expected[0] + 21])


@pytest.mark.parametrize("frame", ["19", "50", "19:30", "20:51", "40:30", "x"])
def test_frames_that_no_clip_is_around_are_refused(tmp_path, spikes, frame):
    write_spikes(tmp_path / "clip.npz", spikes)
    with pytest.raises(ValueError, match=f"frame: expected .* got {frame}; a clip has 41 frames of the 70 of"):
        RecordingClips(str(tmp_path / "clip.npz"), frame=frame)


def test_what_is_white(tmp_path):
    spikes = torch.zeros(2041, 8, 10, dtype=torch.uint8)
    spikes[1000:, 2, 3] = 1  # half of the time
    spikes[::4, 4:] = 1
    write_spikes(tmp_path / "clip.npz", spikes)
    path = str(tmp_path / "clip.npz")
    few = RecordingClips(path, frame="20:60:20")
    assert few.white == RecordingClips(path).white == pytest.approx(0.5, abs=0.02)
    assert [clip["white"].item() for clip in few] == pytest.approx([few.white] * 2)
    assert RecordingClips(path, white=0.1).white == 0.1
    with pytest.raises(ValueError, match="white: expected a finite number above 0, got -1"):
        RecordingClips(path, white=-1)


def test_a_dim_recording_is_shown_bright(tmp_path):
    light = torch.linspace(0, 0.02, 400).reshape(20, 20).expand(121, 20, 20)
    write_spikes(tmp_path / "dim.npz", simulate_spikes(light, generator=torch.Generator().manual_seed(0)))
    words = ["predict", "--model.network", "ClassicalDecoder", "--model.network.method", "tfp"]
    words += ["--data", "Recording", "--data.path", str(tmp_path / "dim.npz"), "-o", str(tmp_path / "out")]
    main([*words, "--data.frame", "40:81:40"])
    pictures = [read_picture(path) for path in sorted((tmp_path / "out").glob("*.png"))]
    assert len(pictures) == 2
    assert all(picture.quantile(0.999) > 0.9 for picture in pictures)
    main([*words, "--data.frame", "40", "--data.white", "0.4"])
    assert read_picture(tmp_path / "out" / "frame_000040.png").max() < 0.2


def test_a_sidecar_knows_size_phase_and_white(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_picture("photo.png", torch.ones(3, 30, 40))
    simulate = ["simulate", "photo.png", "-o", "a.dat", "--scale", "1", "--pattern", "GBRG", "--alpha", "0.3"]
    assert spikekit_main(simulate) == 0
    clips = RecordingClips("a.dat")
    assert (clips.size, clips.recording.pattern, clips.white) == ((29, 40), "GBRG", 0.3)


def test_a_camera_knows_size_phase_and_crop(tmp_path):
    raw = torch.zeros(41, 1000, 1024, dtype=torch.uint8)
    raw[::2] = 1
    write_spikes(tmp_path / "a.dat", raw)
    clips = RecordingClips(str(tmp_path / "a.dat"), camera="m1k40-bayer")
    assert clips.size == clips[0]["spikes"].shape[1:] == (992, 992)


@pytest.mark.parametrize("name", ["clip.dat", "clip.npz"])
@pytest.mark.parametrize("frame", ["20:50:1", "21:50:28"])
def test_clips_in_order_are_those_of_the_file_and_every_frame_is_read_once(tmp_path, spikes, name, frame, monkeypatch):
    write_spikes(tmp_path / name, spikes)
    clips = RecordingClips(str(tmp_path / name), 6, 10, frame=frame, frames=5, white=1.0, pattern="BGGR")
    read, frames_from = [], type(clips.recording).frames_from

    def counted(recording, start):
        for n, plane in enumerate(frames_from(recording, start), start):
            read.append(n)
            yield plane

    monkeypatch.setattr(type(clips.recording), "frames_from", counted)
    found = list(clips.in_order(clips.chosen))
    assert [clip["frame"] for clip in found] == [clip["frame"] for clip in clips]
    assert all(one["spikes"].equal(other["spikes"]) for one, other in zip(found, clips, strict=True))
    assert read == sorted(set(read))
    if name == "clip.dat" and frame == "21:50:28":
        assert read == [*range(19, 24), *range(47, 52)]  # what nobody wants is not read


@pytest.mark.parametrize("processes", [1, 2, 3, 5])
def test_processes_share_the_clips_in_parts_that_follow_each_other(tmp_path, spikes, processes):
    write_spikes(tmp_path / "clip.npz", spikes)
    clips = RecordingClips(str(tmp_path / "clip.npz"), every=7, white=1.0)
    found = [[batch["frame"].item() for batch in _Batches(clips, n, processes)] for n in range(processes)]
    assert [frame for part in found for frame in part] == clips.chosen
    assert max(map(len, found)) - min(map(len, found)) <= 1


@pytest.mark.parametrize("processes", [1, 2, 3])
@pytest.mark.parametrize(("future", "interpolated"), [(0, 0), (2, 0), (0, 2), (1, 1)])
def test_groups_are_those_of_the_film_and_what_comes_before_is_seen_again(
    tmp_path, spikes, processes, future, interpolated
):
    write_spikes(tmp_path / "clip.npz", spikes)
    clips = RecordingClips(str(tmp_path / "clip.npz"), every=2, white=1.0)
    clips.made = {30, 34, 36}
    of_group = list(film_groups(clips.chosen, future, interpolated))
    shown = []
    for process in range(processes):
        batches = list(_Batches(clips, process, processes, future, interpolated, warm_up=4))
        frames = [batch["frame"].tolist() for batch in batches]
        assert all(part in of_group for part in frames)
        assert len(batches) == len(_Batches(clips, process, processes, future, interpolated, warm_up=4))
        seen = [frame for part in frames for frame in part]
        for batch in batches:
            for frame, whether in zip(batch["frame"].tolist(), batch["shown"].tolist(), strict=True):
                shown += [frame] * whether
                before = [n for n in clips.chosen if n < frame][-4:]
                assert not whether or set(before) <= set(seen[: seen.index(frame)])
    assert shown == [frame for frame in clips.chosen if frame not in clips.made]


def test_a_grey_recording_is_not_cropped_to_a_phase(tmp_path, spikes):
    write_spikes(tmp_path / "clip.npz", spikes)
    clips = RecordingClips(str(tmp_path / "clip.npz"), pattern="grey", crop_to="BGGR")
    assert clips.grey
    assert clips[0]["spikes"].equal(spikes[:41])
    write_spikes(tmp_path / "a.dat", torch.zeros(41, 250, 400, dtype=torch.uint8))
    assert RecordingClips(str(tmp_path / "a.dat"), camera="vidar").grey
    assert not RecordingClips(str(tmp_path / "clip.npz")).grey


def test_errors(tmp_path, spikes):
    path = tmp_path / "clip.dat"
    write_spikes(path, spikes[:40])
    with pytest.raises(ValueError, match=r"clip\.dat: expected at least 41 frames for a clip, got 40"):
        RecordingClips(str(path), 6, 10)
    with pytest.raises(SpikeFileError, match=r"none\.dat"):
        RecordingClips(str(tmp_path / "none.dat"), 6, 10)
    with pytest.raises(ValueError, match="every"):
        RecordingClips(str(path), 6, 10, every=0)


def test_a_calibration_beside_the_recording_makes_ideal_spikes(tmp_path):
    defects = torch.zeros(6, 10, dtype=torch.uint8)
    defects[3, 4] = 2
    gain = torch.linspace(0.5, 1.5, 10).repeat(6, 1)
    sensor = Calibration(gain, torch.zeros(6, 10), defects)
    spikes = SpikeSensor(SensorNoise(calibration=sensor)).expose(torch.full((70, 6, 10), 0.2))
    write_spikes(tmp_path / "clip.npz", spikes)
    path = str(tmp_path / "clip.npz")
    (before,) = RecordingClips(path, every=60)
    write_calibration(tmp_path / "clip.calibration.safetensors", sensor)
    (after,) = RecordingClips(path, every=60)
    (without,) = RecordingClips(path, every=60, calibration="none")
    assert before["spikes"].equal(without["spikes"])
    assert before["spikes"].equal(spikes[before["frame"] - 20 :][:41])
    assert (after["spikes"].sum(0) - 41 * 0.2).abs().max() < 2
    assert (before["spikes"].sum(0) - 41 * 0.2).abs().max() > 30
    assert after["white"] < 0.3
    data = Recording(path, every=60, calibration=str(tmp_path / "clip.calibration.safetensors"))
    data.setup("predict")
    (batch,) = data.predict_dataloader()
    assert batch["spikes"][0].equal(after["spikes"])

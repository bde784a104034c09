"""Fine-tuning on a recording: what a lesson shows, what is held out, what is kept, and how it goes on."""

import copy

import pytest
import torch

from lightning_modules.__main__ import main
from lightning_modules.adaptation import cli
from lightning_modules.adaptation import learn as learning
from lightning_modules.adaptation import lessons as making
from lightning_modules.adaptation.learn import learn, likeness
from lightning_modules.adaptation.lessons import HELD_OUT, Lessons, chosen_frames, make_lessons
from lightning_modules.inference.clips import RecordingClips
from lightning_modules.networks import CSCSR
from lightning_modules.registry import find_model
from spikekit import Calibration, simulate_spikes, write_calibration, write_spikes
from spikekit.recording import open_recording


def stripes(frames, height=28, width=24):
    """Stripes of all colours that move sideways."""
    x = torch.arange(width) - 0.05 * torch.arange(frames)[:, None]
    return (0.2 + 0.15 * torch.sin(x / 2))[:, None].expand(frames, height, width)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("adapt") / "recording.npz"
    write_spikes(path, simulate_spikes(stripes(160)))
    return path


@pytest.fixture(scope="module")
def lessons(recording):
    student, teacher = CSCSR.from_pretrained("cscsr_tiny_x4").eval(), CSCSR.from_pretrained("cscsr_small_x4").eval()
    return make_lessons(student, teacher, RecordingClips(open_recording(recording, pattern="RGGB"), 41))


@pytest.mark.parametrize(("total", "frames"), [(123, 41), (124, 41), (303, 101), (1000, 101), (20_000, 41)])
def test_no_clip_that_is_held_out_overlaps_one_that_is_taught(total, frames):
    chosen = chosen_frames(total, frames)
    taught, held_out = chosen[:-HELD_OUT], chosen[-HELD_OUT:]
    assert min(taught) - frames // 2 == 0
    assert max(held_out) + frames // 2 == total - 1
    assert min(held_out) - frames // 2 > max(taught) + frames // 2
    assert chosen == sorted(chosen)


def test_lessons_are_what_the_student_would_see_where_it_is_the_teacher(recording, monkeypatch):
    monkeypatch.setattr(making, "_SIDE", 20)  # windows, by chance
    student = CSCSR.from_pretrained("cscsr_tiny_x4").eval()
    clips = RecordingClips(open_recording(recording, pattern="BGGR"), 51)  # longer than the student's
    assert clips.size == (27, 23)
    brighter = CSCSR.from_pretrained("cscsr_tiny_x4", alpha=0.2).eval()  # half the light is white
    made = make_lessons(student, brighter, clips)
    assert made.spikes.shape == (16, 41, 20, 20)
    assert made.rgb.shape == (16, 3, 80, 80)
    assert likeness(student, made) > 60
    assert likeness(CSCSR.from_pretrained("cscsr_small_x4").eval(), made) < 50
    worse = Lessons(made.spikes.roll(1, dims=1), made.rgb, made.flow, made.white)
    assert likeness(student, worse) < 50


@pytest.mark.parametrize(("total", "frames"), [(101, 41), (102, 41), (102, 40), (41, 41)])
def test_both_networks_see_the_same_moment(total, frames):
    """That of a clip is its frame ``frames // 2``."""
    cut = making._middle(torch.arange(total).view(1, -1, 1, 1), frames)
    assert cut.shape[1] == frames
    assert cut[0, frames // 2].item() == total // 2


def test_patches_keep_place_time_and_motion_together(monkeypatch):
    monkeypatch.setattr(learning, "_PATCH", 8)
    spikes = torch.arange(3 * 12 * 20, dtype=torch.float32).reshape(1, 3, 12, 20)
    rgb = spikes[:, 1:2].repeat_interleave(2, -1).repeat_interleave(2, -2).expand(1, 3, 24, 40)
    along = torch.stack([spikes[:, 0], spikes[:, 2]], dim=1)  # (1, 2, 12, 20)
    lessons = Lessons(spikes, rgb, torch.stack([along, along + 1000], dim=2), 1.0)
    patches = learning.Patches(lessons, "RGGB", 2)
    kinds = set()
    for number in range(60):
        patch = patches[number]
        clip, flow = patch["spikes"], patch["flow"]
        assert clip.shape == (3, 8, 8)
        assert torch.equal(patch["rgb"][0, ::2, ::2], clip[1])
        backwards, transposed = bool(clip[0, 0, 0] > clip[2, 0, 0]), bool(clip[1, 1, 0] == clip[1, 0, 0] + 1)
        assert torch.equal(flow[:, int(transposed)], clip[[0, 2]])
        assert torch.equal(flow[:, 1 - int(transposed)], clip[[0, 2]] + 1000)
        assert clip[1, 0, 0] % 20 % 2 == clip[1, 0, 0] // 20 % 2 == 0  # the Bayer phase
        kinds.add((backwards, transposed))
    assert len(kinds) == 4
    whole = [learning.Patches(lessons, "GRBG", 2)[number]["spikes"][1] for number in range(60)]
    assert all(plane[0, 1] == plane[0, 0] + 1 for plane in whole)


def test_a_student_comes_nearer_to_its_teacher_on_what_is_held_out(lessons, tmp_path):
    student = CSCSR.from_pretrained("cscsr_tiny_x4").eval()
    before, after = learn(student, lessons, 10, tmp_path)
    assert after > before + 0.3
    assert not student.training
    fresh = CSCSR.from_pretrained("cscsr_tiny_x4").eval()
    assert before == likeness(fresh, lessons.part(slice(-HELD_OUT, None)))
    assert after == likeness(student, lessons.part(slice(-HELD_OUT, None)))


class KilledError(RuntimeError):
    pass


def test_it_is_resumed_where_it_was_interrupted(lessons, tmp_path, monkeypatch):
    monkeypatch.setattr(learning, "_EVERY", 3)
    begun = CSCSR.from_pretrained("cscsr_tiny_x4").eval()
    read, seen = learning.Patches.__getitem__, []

    def until(last):
        def getitem(patches, index):
            if index == last:
                raise KilledError
            seen.append(index)
            return read(patches, index)

        monkeypatch.setattr(learning.Patches, "__getitem__", getitem)

    until(5 * 4)
    with pytest.raises(KilledError):
        learn(copy.deepcopy(begun), lessons, 8, tmp_path / "run")
    resumed, whole = copy.deepcopy(begun), copy.deepcopy(begun)
    until(None)
    seen.clear()
    before, _ = learn(resumed, lessons, 8, tmp_path / "run")
    assert seen == list(range(3 * 4, 8 * 4))  # after the third, which was the last to be kept
    assert before == likeness(begun, lessons.part(slice(-HELD_OUT, None)))
    learn(whole, lessons, 8, tmp_path / "whole")
    for one, other in zip(resumed.parameters(), whole.parameters(), strict=True):
        assert torch.allclose(one, other, rtol=0, atol=1e-6)


@pytest.mark.parametrize("kept", ["lessons.safetensors", "state.safetensors"])
def test_what_is_kept_is_resumed_from_or_refused_in_one_line(lessons, tmp_path, fuzz, kept):
    """Bytes and values damaged in any way; a kept file is read before anything is computed."""
    student = CSCSR(4, width=4, representation_width=4, features=1, stages=1, end_blocks=1)
    optimizer = torch.optim.Adam(student.parameters())
    if kept == "state.safetensors":
        learning._write_state(tmp_path / kept, student, optimizer, 3)
    else:
        lessons.write(tmp_path / kept, {})
    whole = (tmp_path / kept).read_bytes()

    def read(path):
        if kept == "state.safetensors":
            learning._read_state(path, student, optimizer, 8)
        else:
            Lessons.read(path, {})

    read(tmp_path / kept)
    fuzz(read, lambda rng: fuzz.damage(whole, rng), kept, cases=60, megabytes=600)


@pytest.mark.parametrize(
    "wrong",
    [
        {"spikes": torch.full((16, 41, 8, 8), 255, dtype=torch.uint8)},
        {"rgb": torch.full((16, 3, 32, 32), float("nan"), dtype=torch.float16)},
        {"flow": torch.full((16, 2, 2, 8, 8), 1e30)},
        {"white": 0.0},
    ],
)
def test_lessons_that_no_recording_gives_are_refused(tmp_path, wrong):
    good = {
        "spikes": torch.ones(16, 41, 8, 8, dtype=torch.uint8),
        "rgb": torch.ones(16, 3, 32, 32, dtype=torch.float16),
        "flow": torch.ones(16, 2, 2, 8, 8),
        "white": 1.0,
    }
    Lessons(**good).write(tmp_path / "good.safetensors", {})
    Lessons.read(tmp_path / "good.safetensors", {})
    Lessons(**{**good, **wrong}).write(tmp_path / "bad.safetensors", {})
    with pytest.raises(ValueError, match=r"bad\.safetensors: not lessons of lightning adapt"):
        Lessons.read(tmp_path / "bad.safetensors", {})


def test_nothing_is_written_through_links_or_into_pipes(recording, tmp_path):
    (tmp_path / "secret").write_text("secret")
    for name in ("lessons.safetensors", "state.safetensors", "adapted.safetensors"):
        out = tmp_path / name.partition(".")[0]
        out.mkdir()
        (out / name).symlink_to(tmp_path / "secret")
        with pytest.raises(SystemExit, match=f"{name}: expected a file or nothing, got a link"):
            main(typed(recording, out))
    assert (tmp_path / "secret").read_text() == "secret"


def typed(recording, output, *more):
    return ["adapt", str(recording), "--pattern", "RGGB", "--weights", "cscsr_tiny_x4", "-o", str(output), *more]


def test_the_command(recording, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(learning, "_EVERY", 4)
    asked = typed(recording, tmp_path / "out", "--teacher", "cscsr_small_x4", "--steps", "8")
    main(asked)
    written = tmp_path / "out" / "adapted.safetensors"
    said = capsys.readouterr().out
    assert "dB from the held-out pictures of cscsr_small_x4 before, " in said
    assert f"lightning predict --weights {written}" in said
    adapted, shipped = CSCSR.from_pretrained(written), CSCSR.from_pretrained("cscsr_tiny_x4")
    assert adapted.settings == shipped.settings
    assert any(not torch.equal(a, b) for a, b in zip(adapted.parameters(), shipped.parameters(), strict=True))
    first = written.read_bytes()
    written.unlink()
    monkeypatch.setattr(learning.Patches, "__getitem__", None)
    main(asked)  # nothing is left to learn
    assert written.read_bytes() == first
    main(["predict", str(recording), "--weights", str(written), "--frame", "80", "-o", str(tmp_path / "a.png")])
    assert (tmp_path / "a.png").is_file()
    with pytest.raises(SystemExit, match=r"steps: expected 8 of the adaptation in .*, got 9; -o goes elsewhere"):
        main([*asked[:-1], "9"])


def test_what_gains_nothing_is_not_kept(recording, tmp_path):
    with pytest.raises(SystemExit, match=r"expected 0\.1 dB more; nothing written, go on using cscsr_tiny_x4"):
        main(typed(recording, tmp_path, "--teacher", "cscsr_tiny_x4", "--steps", "1"))
    assert not (tmp_path / "adapted.safetensors").exists()


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        (
            ["--teacher", "cscsr_base_x2"],
            "--teacher: expected scale 4 of the weights that learn, got 2",
        ),
        (["--teacher", "cscsr_huge_long_x4"], "expected at least 303 frames, 3 clips of 101, got 160"),
        (["--teacher", "ClassicalDecoder"], "--teacher: expected weights, got ClassicalDecoder, which has none"),
        (["--weights", "ClassicalDecoder"], "--weights: expected a network that learns"),
        (
            ["--weights", "cscsr_large_film_x4"],
            "--weights: expected a network that learns",
        ),
        (["-o", "out.safetensors"], "-o: expected a folder, got out.safetensors, which ends like a file"),
        (["--weights", "none"], "none: neither a file of weights nor the name"),
    ],
)
def test_errors_are_one_line(recording, tmp_path, capsys, more, expected):
    with pytest.raises(SystemExit) as error:
        main(typed(recording, tmp_path / "out", *more))
    said = str(error.value.code) if isinstance(error.value.code, str) else capsys.readouterr().err
    assert expected in said
    assert "\n" not in said.strip()


def test_a_recording_that_is_too_short_for_any_teacher(tmp_path):
    write_spikes(tmp_path / "short.npz", torch.ones(100, 8, 8, dtype=torch.uint8))
    with pytest.raises(SystemExit, match=r"short\.npz: expected at least 123 frames"):
        main(typed(tmp_path / "short.npz", tmp_path / "out"))


@pytest.mark.parametrize(
    ("weights", "frames", "measured", "expected"),
    [
        ("cscsr_small_x4", 303, None, "cscsr_huge_long_noisy_x4"),
        ("cscsr_small_x4", 302, None, "cscsr_huge_noisy_x4"),
        ("cscsr_small_x4", 303, 0.01, "cscsr_huge_long_x4"),
        ("cscsr_base_x2", 303, None, "cscsr_huge_x2"),
    ],
)
def test_the_teacher_is_the_slowest_for_such_a_sensor(tmp_path, weights, frames, measured, expected):
    path = tmp_path / "camera.npz"
    write_spikes(path, torch.ones(frames, 6, 6, dtype=torch.uint8))
    if measured is not None:
        planes = torch.ones(6, 6), torch.full((6, 6), measured), torch.zeros(6, 6, dtype=torch.uint8)
        write_calibration(tmp_path / "camera.calibration.safetensors", Calibration(*planes))
    recording = open_recording(path)
    noisy = recording.calibration is None
    clips, name = cli.clips_and_teacher(recording, CSCSR.from_pretrained(weights), None, noisy)
    assert name == expected
    assert clips.frames == CSCSR.from_pretrained(expected).frames


def test_pictures_that_are_no_numbers_are_not_kept(recording, tmp_path, monkeypatch):
    monkeypatch.setattr(cli, "learn", lambda *_, **__: (30.0, float("nan")))
    with pytest.raises(SystemExit, match="nothing written"):
        main(typed(recording, tmp_path, "--teacher", "cscsr_small_x4"))
    assert not (tmp_path / "adapted.safetensors").exists()


def test_what_lies_in_the_folder_is_of_this_adaptation(recording, lessons, tmp_path, monkeypatch):
    """Another training, other weights of the same name, another calibration, damaged files."""
    monkeypatch.setattr(cli, "make_lessons", lambda *_: lessons)
    monkeypatch.setattr(cli, "learn", lambda *_, **__: (30.0, 31.0))
    mine, data = tmp_path / "mine.safetensors", tmp_path / "data.npz"
    mine.write_bytes(find_model("cscsr_tiny_x4").path.read_bytes())
    data.write_bytes(recording.read_bytes())
    asked = typed(data, tmp_path / "out", "--teacher", "cscsr_small_x4", "--weights", str(mine))
    main(asked)
    kept = tmp_path / "out" / "lessons.safetensors"
    whole = kept.read_bytes()
    planes = torch.ones(28, 24), torch.zeros(28, 24), torch.zeros(28, 24, dtype=torch.uint8)
    write_calibration(tmp_path / "data.calibration.safetensors", Calibration(*planes))
    with pytest.raises(SystemExit, match=r"sensor: expected that of the adaptation in .*, got another; "):
        main(asked)
    (tmp_path / "data.calibration.safetensors").unlink()
    mine.write_bytes(mine.read_bytes())
    with pytest.raises(SystemExit, match="weights: expected that of the adaptation in"):
        main(asked)
    kept.write_bytes(whole[:1000])
    with pytest.raises(SystemExit, match=r"lessons\.safetensors: not lessons of lightning adapt"):
        main(asked)
    kept.unlink()
    (tmp_path / "out" / "state.safetensors").write_bytes(b"")
    with pytest.raises(SystemExit, match=r"state\.safetensors: expected the lessons of this training beside it"):
        main(asked)

"""Fine-tuning on a recording: examples, the held-out part, and the written weights."""

import pytest
import torch

from lightning_modules.__main__ import main
from lightning_modules.adaptation import cli
from lightning_modules.adaptation import distillation as making
from lightning_modules.adaptation import fine_tune as learning
from lightning_modules.adaptation.distillation import HELD_OUT, DistillationSet, chosen_frames, make_distillation_set
from lightning_modules.adaptation.fine_tune import fine_tune, likeness, patch_of
from lightning_modules.inference.clips import RecordingClips
from lightning_modules.networks import CSCSR
from spikekit import Calibration, simulate_spikes, write_calibration, write_spikes
from spikekit.recording import open_recording


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A recording of grey stripes that move sideways."""
    path = tmp_path_factory.mktemp("adapt") / "recording.npz"
    x = torch.arange(24) - 0.05 * torch.arange(160)[:, None]
    write_spikes(path, simulate_spikes((0.2 + 0.15 * torch.sin(x / 2))[:, None].expand(160, 28, 24)))
    return path


@pytest.mark.parametrize(("total", "frames"), [(123, 41), (1000, 101)])
def test_held_out_clips_do_not_overlap_with_training_clips(total, frames):
    chosen = chosen_frames(total, frames)
    taught, held_out = chosen[:-HELD_OUT], chosen[-HELD_OUT:]
    assert min(taught) - frames // 2 == 0
    assert max(held_out) + frames // 2 == total - 1
    assert min(held_out) - frames // 2 > max(taught) + frames // 2
    assert chosen == sorted(chosen)


def test_student_matches_lessons_made_by_itself(recording, monkeypatch):
    monkeypatch.setattr(making, "_SIDE", 20)  # random windows
    student = CSCSR.from_pretrained("cscsr_tiny_x4").eval()
    clips = RecordingClips(open_recording(recording, pattern="BGGR"), 51)  # longer than those of the student
    assert clips.size == (27, 23)
    brighter = CSCSR.from_pretrained("cscsr_tiny_x4", alpha=0.2).eval()  # half the light gives white
    made = make_distillation_set(student, brighter, clips)
    assert made.spikes.shape == (16, 41, 20, 20)
    assert made.rgb.shape == (16, 3, 80, 80)
    made = made.part(slice(3))
    assert likeness(student, made) > 60
    assert likeness(CSCSR.from_pretrained("cscsr_small_x4").eval(), made) < 50
    worse = DistillationSet(made.spikes.roll(1, dims=1), made.rgb, made.flow, made.white)
    assert likeness(student, worse) < 50


def test_patches_keep_spikes_pictures_and_motion_aligned(monkeypatch):
    monkeypatch.setattr(learning, "_PATCH", 8)
    spikes = torch.arange(3 * 12 * 20, dtype=torch.float32).reshape(1, 3, 12, 20)
    rgb = spikes[:, 1:2].repeat_interleave(2, -1).repeat_interleave(2, -2).expand(1, 3, 24, 40)
    along = torch.stack([spikes[:, 0], spikes[:, 2]], dim=1)  # (1, 2, 12, 20)
    examples = DistillationSet(spikes, rgb, torch.stack([along, along + 1000], dim=2), 1.0)
    kinds = set()
    for number in range(60):
        patch = patch_of(examples, "RGGB", 2, number)
        clip, flow = patch["spikes"], patch["flow"]
        assert clip.shape == (3, 8, 8)
        assert torch.equal(patch["rgb"][0, ::2, ::2], clip[1])
        backwards, transposed = bool(clip[0, 0, 0] > clip[2, 0, 0]), bool(clip[1, 1, 0] == clip[1, 0, 0] + 1)
        assert torch.equal(flow[:, int(transposed)], clip[[0, 2]])
        assert torch.equal(flow[:, 1 - int(transposed)], clip[[0, 2]] + 1000)
        assert clip[1, 0, 0] % 20 % 2 == clip[1, 0, 0] // 20 % 2 == 0  # the Bayer phase
        kinds.add((backwards, transposed))
    assert len(kinds) == 4
    whole = [patch_of(examples, "GRBG", 2, number)["spikes"][1] for number in range(60)]
    assert all(plane[0, 1] == plane[0, 0] + 1 for plane in whole)


def test_student_approaches_its_teacher_on_held_out_lessons(recording):
    student, fresh = (CSCSR.from_pretrained("cscsr_tiny_x4").eval() for _ in range(2))
    teacher = CSCSR.from_pretrained("cscsr_small_x4").eval()
    examples = make_distillation_set(student, teacher, RecordingClips(open_recording(recording, pattern="RGGB"), 41))
    before, after = fine_tune(student, examples, 10)
    assert after > before + 0.3
    assert not student.training
    assert before == likeness(fresh, examples.part(slice(-HELD_OUT, None)))
    assert after == likeness(student, examples.part(slice(-HELD_OUT, None)))


def typed(recording, output, *more):
    return ["adapt", str(recording), "--pattern", "RGGB", "--weights", "cscsr_tiny_x4", "-o", str(output), *more]


def test_command_writes_usable_weights(recording, tmp_path, capsys):
    main(typed(recording, tmp_path / "out", "--teacher", "cscsr_small_x4", "--steps", "8"))
    written = tmp_path / "out" / "adapted.safetensors"
    said = capsys.readouterr().out
    assert "dB PSNR to the held-out pictures of cscsr_small_x4 before, " in said
    assert f"lightning predict --weights {written}" in said
    adapted, shipped = CSCSR.from_pretrained(written), CSCSR.from_pretrained("cscsr_tiny_x4")
    assert adapted.settings == shipped.settings
    assert any(not torch.equal(a, b) for a, b in zip(adapted.parameters(), shipped.parameters(), strict=True))
    main(["predict", str(recording), "--weights", str(written), "--frame", "80", "-o", str(tmp_path / "a.png")])
    assert (tmp_path / "a.png").is_file()


@pytest.mark.parametrize("after", [30.05, float("nan")])
def test_weights_without_gain_are_not_written(recording, tmp_path, monkeypatch, after):
    monkeypatch.setattr(cli, "fine_tune", lambda *_: (30.0, after))
    monkeypatch.setattr(cli, "make_distillation_set", lambda *_: None)
    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(SystemExit, match=r"expected a gain of 0\.1 dB; nothing written, keep using cscsr_tiny_x4"):
        main(typed(recording, "~"))
    assert [path.name for path in tmp_path.iterdir()] == ["lock"]


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        (["--teacher", "cscsr_base_x2"], "--teacher: expected scale 4, as in --weights, got 2"),
        (["--teacher", "cscsr_huge_long_x4"], "expected at least 303 frames, 3 clips of 101, got 160"),
        (["-o", "out.safetensors"], "-o: expected a folder, got out.safetensors, which has the ending of a file"),
    ],
)
def test_errors_are_one_line(recording, tmp_path, capsys, more, expected):
    with pytest.raises(SystemExit) as error:
        main(typed(recording, tmp_path / "out", *more))
    said = str(error.value.code) if isinstance(error.value.code, str) else capsys.readouterr().err
    assert expected in said
    assert "\n" not in said.strip()


@pytest.mark.parametrize(
    ("weights", "frames", "measured", "expected"),
    [
        ("cscsr_small_x4", 303, None, "cscsr_huge_long_noisy_x4"),
        ("cscsr_small_x4", 302, None, "cscsr_huge_noisy_x4"),
        ("cscsr_small_x4", 303, 0.01, "cscsr_huge_long_x4"),
        ("cscsr_base_x2", 303, None, "cscsr_huge_x2"),
        ("cscsr_tiny_x4", 100, None, None),
    ],
)
def test_default_teacher_is_the_largest_for_the_sensor(tmp_path, weights, frames, measured, expected):
    path = tmp_path / "camera.npz"
    write_spikes(path, torch.ones(frames, 6, 6, dtype=torch.uint8))
    if measured is not None:
        planes = torch.ones(6, 6), torch.full((6, 6), measured), torch.zeros(6, 6, dtype=torch.uint8)
        write_calibration(tmp_path / "camera.calibration.safetensors", Calibration(*planes))
    recording = open_recording(path)
    if expected is None:
        with pytest.raises(ValueError, match=r"camera\.npz: expected at least 123 frames"):
            cli.clips_and_teacher(recording, CSCSR.from_pretrained(weights), None, True)
        return
    noisy = recording.calibration is None
    clips, name, teacher = cli.clips_and_teacher(recording, CSCSR.from_pretrained(weights), None, noisy)
    assert name == expected
    assert clips.frames == teacher.frames

"""The command ``lightning adapt``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

import torch

from lightning_modules.adaptation.learn import learn
from lightning_modules.adaptation.lessons import ROOM, Lessons, make_lessons
from lightning_modules.cli.command import precision_of, without_chatter
from lightning_modules.cli.errors import InputError, UsageError, VerbParser
from lightning_modules.cli.folder_lock import locked_folder
from lightning_modules.data.recording import RecordingClips
from lightning_modules.inference.export import load_network
from lightning_modules.networks import Network, RecurrentCSCSR
from lightning_modules.storage.pretrained import Weights, motion_of, settings_of, write_weights
from lightning_modules.storage.shipped import list_pretrained
from lightning_modules.tasks.predictions import file_identity
from spikekit.arguments import whole
from spikekit.color.cfa import PATTERNS
from spikekit.io import recording as recordings
from spikekit.timing import duration

#: dB by which the held-out pictures have to come nearer to the teacher's
LEAST_GAIN = 0.1

_WRITTEN = "adapted.safetensors"


def parser() -> argparse.ArgumentParser:
    """Return the parser of the verb."""
    made = VerbParser(
        prog="lightning adapt",
        description="Fine-tune fast weights on a recording of your camera, without ground truth: they learn from the "
        "pictures that slower weights make of it. The end of the recording is held out, and decides whether the new "
        "weights are kept. lightning predict --model.weights OUT/adapted.safetensors uses them, also on other "
        "recordings of the camera.",
    )
    recordings.add_arguments(made)
    made.add_argument("--pattern", type=str.upper, choices=(*PATTERNS, "GREY"), help="Bayer phase after the flip")
    recordings.add_calibration(made)
    made.add_argument("--weights", default="cscsr_small_x4", help="what to begin with; cscsr_small_x4 if not given")
    made.add_argument(
        "--teacher",
        help="weights to learn from; if not given, the slowest of the package that the recording has room for, those "
        "for a noisy sensor where the sensor was not measured",
    )
    made.add_argument("--steps", type=whole(1), default=100, help="how long to learn; 100 if not given")
    made.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="folder of what is written")
    return made


def adapt(args: Sequence[str]) -> None:
    """Fine-tune weights on a recording.

    Args:
        args: what was typed after ``lightning adapt``.

    Raises:
        InputError: a recording that is too short or cannot be read, unusable weights, or nothing was gained.
    """
    without_chatter()
    asked = parser().parse_args(args)
    begin = perf_counter()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    with locked_folder(asked.output, "adaptation"):
        try:
            student = _student(asked.weights)
            clips, name = _clips_and_teacher(asked, student)
            lessons = _lessons(asked, name, clips, student.to(device), device)
        except (OSError, ValueError) as error:
            raise (UsageError if isinstance(error, UsageError) else InputError)(str(error)) from error
        how = {"precision": precision_of("auto"), "enable_progress_bar": sys.stderr.isatty()}
        before, after = learn(student, lessons, asked.steps, asked.output, **how)
        said = f"{before:.2f} dB from the held-out pictures of {name} before, {after:.2f} dB after {asked.steps} steps"
        if after < before + LEAST_GAIN:
            raise InputError(f"{asked.weights}: {said}: expected {LEAST_GAIN} dB more; use them as they are")
        written = asked.output / _WRITTEN
        weights = Weights(written, settings_of(student), motion_of(student), student.cpu().state_dict())
        write_weights(weights, written)
    print(f"{said}\n{written}: in {duration(perf_counter() - begin)}; lightning predict --model.weights {written}")


def _student(weights: str) -> Network:
    student = load_network(weights)
    if isinstance(student, RecurrentCSCSR) or not any(True for _ in student.parameters()):
        raise UsageError(f"--weights: expected a network that learns from single clips, got {weights}")
    return student


def _clips_and_teacher(asked: argparse.Namespace, student: Network) -> tuple[RecordingClips, str]:
    how = {name: getattr(asked, name) for name in ("height", "width", "flip", "camera", "calibration")}
    how["pattern"] = asked.pattern and (asked.pattern if asked.pattern in PATTERNS else "grey")
    how["crop_to"] = student.pattern
    clips = RecordingClips(str(asked.file), **how, frames=student.frames)
    name = asked.teacher or _slowest(clips, student)
    teacher = load_network(name)
    if not any(True for _ in teacher.parameters()):
        raise UsageError(f"--teacher: expected weights, got {name}, which has none")
    for setting in ("scale", "pattern"):
        here, there = student.settings[setting], teacher.settings[setting]
        if here != there:
            raise UsageError(f"--teacher: expected {setting} {here} of {asked.weights}, got {there} of {name}")
    frames = max(student.frames, teacher.frames)
    if clips.recording.frames < ROOM * frames:
        least = f"at least {ROOM * frames} frames, {ROOM} clips of {frames}"
        raise ValueError(f"{asked.file}: expected {least}, got {clips.recording.frames}")
    return RecordingClips(str(asked.file), **how, frames=frames), name


def _slowest(clips: RecordingClips, student: Network) -> str:
    """Return the weights that make the best pictures of this recording, as far as one can know."""
    known, measured = clips.recording.alpha is not None, clips.recording.calibration
    noisy = not known and (measured is None or not measured.dark.any())
    room = clips.recording.frames // ROOM
    fit = [one for one in list_pretrained(student.scale) if not one.film and one.frames <= room]
    if not fit:
        least = f"at least {ROOM * student.frames} frames, {ROOM} clips of {student.frames}"
        raise ValueError(f"{clips.recording.path}: expected {least}, got {clips.recording.frames}")
    of_sensor = [one for one in fit if ("noisy" in one.name) == noisy] or fit
    return max(of_sensor, key=lambda one: one.macs).name


def _lessons(asked: argparse.Namespace, name: str, clips: RecordingClips, student: Network, device: str) -> Lessons:
    """What the teacher sees: as it was written before, or seen now."""
    teacher = load_network(name).to(device).eval()
    identity = {
        "recording": file_identity(asked.file),
        "sensor": [*clips.size, clips.top, clips.left, clips.grey, asked.flip, clips.white, str(asked.calibration)],
        "weights": asked.weights,
        "teacher": name,
        "steps": asked.steps,
    }
    path = asked.output / "lessons.safetensors"
    if path.is_file():
        return Lessons.read(path, identity)
    lessons = make_lessons(student, teacher, clips)
    lessons.write(path, identity)
    return lessons

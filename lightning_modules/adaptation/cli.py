"""The command ``lightning adapt``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

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
from spikekit.io.recording import own_calibration
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
    add = made.add_argument
    add("--data", choices=["Recording"], help="as lightning predict wants it; may be left out")
    add("--data.path", required=True, metavar="FILE", help="the recording, .dat or .npz")
    add("--data.height", type=whole(1), metavar="H", help="rows of a frame; a .dat without side-car or camera needs it")
    add("--data.width", type=whole(1), metavar="W", help="columns of a frame; likewise")
    add("--data.flip", choices=["true", "false"], help="the frames are stored upside down, as real cameras do")
    add("--data.pattern", choices=[*PATTERNS, "grey"], help="Bayer phase after the flip; RGGB if nothing else is known")
    add("--data.camera", metavar="NAME", help="instead of all these, what recorded it, see spikekit cameras")
    add(
        "--data.calibration",
        metavar="FILE",
        help="what spikekit calibrate wrote; that beside FILE if not given; or none",
    )
    add("--model.weights", default="cscsr_small_x4", help="what to begin with; cscsr_small_x4 if not given")
    add(
        "--teacher",
        help="weights to learn from; if not given, the slowest of the package that the recording has room for, those "
        "for a noisy sensor where the sensor was not measured",
    )
    add("--steps", type=whole(1), default=100, help="how long to learn; 100 if not given")
    add("-o", "--output", type=Path, required=True, metavar="OUT", help="folder of what is written")
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
    data = {name.removeprefix("data."): value for name, value in vars(asked).items() if name.startswith("data.")}
    data["flip"] = data["flip"] == "true"
    weights = vars(asked)["model.weights"]
    begin = perf_counter()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    with locked_folder(asked.output, "adaptation"):
        try:
            student = _student(weights)
            clips, name = clips_and_teacher(data, student, asked.teacher)
            path = asked.output / "lessons.safetensors"
            identity = {"recording": file_identity(data["path"]), "sensor": _sensor(clips, data["calibration"])}
            identity |= {"weights": weights, "teacher": name, "steps": asked.steps}
            if path.is_file():
                lessons = Lessons.read(path, identity)
            else:
                lessons = make_lessons(student.to(device), load_network(name).to(device).eval(), clips)
                lessons.write(path, identity)
            how = {"precision": precision_of("auto"), "enable_progress_bar": sys.stderr.isatty()}
            before, after = learn(student, lessons, asked.steps, asked.output, **how)
        except (OSError, ValueError) as error:
            raise (UsageError if isinstance(error, UsageError) else InputError)(str(error)) from error
        said = f"{before:.2f} dB from the held-out pictures of {name} before, {after:.2f} dB after {asked.steps} steps"
        if after < before + LEAST_GAIN:
            raise InputError(f"{weights}: {said}: expected {LEAST_GAIN} dB more; use them as they are")
        written = asked.output / _WRITTEN
        tensors = student.cpu().state_dict()
        write_weights(Weights(written, settings_of(student), motion_of(student), tensors), written)
    print(f"{said}\n{written}: in {duration(perf_counter() - begin)}; for lightning predict --model.weights {written}")


def _student(weights: str) -> Network:
    student = load_network(weights)
    if isinstance(student, RecurrentCSCSR) or not any(True for _ in student.parameters()):
        raise UsageError(f"--model.weights: expected a network that learns from single clips, got {weights}")
    return student.eval()


def clips_and_teacher(data: dict[str, Any], student: Network, teacher: str | None) -> tuple[RecordingClips, str]:
    """Return clips as long as the longer of both networks wants them, and the name of the teacher.

    Args:
        data: arguments of RecordingClips.
        student: what learns.
        teacher: what was asked for.

    Raises:
        spikekit.SpikeFileError: the recording cannot be read.
        ValueError: it is too short, or the teacher does not fit.
    """
    data = data | {"crop_to": student.pattern}
    clips = RecordingClips(**data, frames=student.frames)
    name = teacher or _slowest(clips, student)
    network = load_network(name)
    if not any(True for _ in network.parameters()):
        raise UsageError(f"--teacher: expected weights, got {name}, which has none")
    for setting in ("scale", "pattern"):
        here, there = student.settings[setting], network.settings[setting]
        if here != there:
            raise UsageError(f"--teacher: expected {setting} {here} of the weights that learn, got {there} of {name}")
    frames = max(student.frames, network.frames)
    if clips.recording.frames < ROOM * frames:
        raise ValueError(_too_short(clips, frames))
    return RecordingClips(**data, frames=frames), name


def _slowest(clips: RecordingClips, student: Network) -> str:
    """Return the weights that make the best pictures of this recording, as far as one can know."""
    known, measured = clips.recording.alpha is not None, clips.recording.calibration
    noisy = not known and (measured is None or not measured.dark.any())
    room = clips.recording.frames // ROOM
    fit = [one for one in list_pretrained(student.scale) if not one.film and one.frames <= room]
    if not fit:
        raise ValueError(_too_short(clips, student.frames))
    of_sensor = [one for one in fit if ("noisy" in one.name) == noisy] or fit
    return max(of_sensor, key=lambda one: one.macs).name


def _too_short(clips: RecordingClips, frames: int) -> str:
    least = f"at least {ROOM * frames} frames, {ROOM} clips of {frames}"
    return f"{clips.recording.path}: expected {least}, got {clips.recording.frames}"


def _sensor(clips: RecordingClips, calibration: str | None) -> list[Any]:
    """Return what the spikes depend on besides the file."""
    own = own_calibration(clips.recording.path) if calibration is None else Path(calibration)
    measured = file_identity(own) if own.is_file() else None
    return [*clips.size, clips.top, clips.left, clips.recording.flip, clips.grey, measured]

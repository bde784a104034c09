"""The command ``lightning adapt``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from time import perf_counter

import torch

from lightning_modules.adaptation.distillation import ROOM, make_distillation_set
from lightning_modules.adaptation.fine_tune import fine_tune
from lightning_modules.cli.errors import InputError, UsageError, VerbParser, input_errors
from lightning_modules.cli.folder_lock import check_folder, locked_folder
from lightning_modules.inference.clips import NOISY, RecordingClips
from lightning_modules.inference.output import check_place
from lightning_modules.inference.predict import precision_of
from lightning_modules.inference.reconstruct import other_sensor
from lightning_modules.networks import Network
from lightning_modules.registry import list_models
from lightning_modules.storage.pretrained import Weights, motion_of, settings_of, write_weights
from spikekit.arguments import home_path, whole
from spikekit.cli import recordings
from spikekit.color.cfa import GREY
from spikekit.recording import Recording
from spikekit.timing import duration

#: required gain on the held-out pictures, in dB of PSNR to the teacher's
LEAST_GAIN = 0.1

_WRITTEN = "adapted.safetensors"


def parser() -> argparse.ArgumentParser:
    """Return the parser of the verb."""
    made = VerbParser(
        prog="lightning adapt",
        description="Fine-tune a small model on a recording of your camera, with a large one as teacher and without "
        "ground truth. The end of the recording is held out, and the new weights are written only if its pictures "
        "improve. Use them with lightning predict --weights OUT/adapted.safetensors; for a noisy camera, also on its "
        "other recordings.",
    )
    recordings.add_arguments(made)
    add = made.add_argument
    add("--weights", help="weights to fine-tune (default: cscsr_small_x4, or cscsr_small_grey_x1 for a grey camera)")
    add(
        "--teacher",
        help="weights to learn from (default: the largest model in the package whose clips fit the recording three "
        "times; one for noisy sensors if the sensor turns out to be noisy)",
    )
    add("--steps", type=whole(1), default=100, help="training steps (default: 100)")
    add("-o", "--output", type=home_path, required=True, metavar="OUT", help="output folder")
    return made


def adapt(args: Sequence[str]) -> None:
    """Fine-tune weights on a recording, given the arguments after ``lightning adapt``."""
    asked = parser().parse_args(args)
    begin, written = perf_counter(), asked.output / _WRITTEN
    device = "cuda" if torch.cuda.is_available() else "cpu"
    with input_errors():
        check_folder(asked.output)
        check_place(written)
        recording = recordings.opened(asked)
        weights = asked.weights or ("cscsr_small_grey_x1" if recording.pattern == GREY else "cscsr_small_x4")
        student = Network.from_pretrained(weights).to(device)
        if student.settings.get("motion_fusion", "joint") != "joint":
            raise UsageError(f"--weights: expected a network with one flow for all colours, got {weights}")
        if warning := other_sensor(recording, student.pattern):
            print(warning, flush=True)
        level = RecordingClips(recording).noise_level
        clips, name, teacher = clips_and_teacher(recording, student, asked.teacher, level > NOISY)
        student.noise_level = teacher.noise_level = level * clips.joined**0.5
        with locked_folder(asked.output, "adaptation"):
            examples = make_distillation_set(student, teacher.to(device).eval(), clips)
            precision = precision_of(torch.device(device)) if device == "cuda" else "32-true"
            before, after = fine_tune(student, examples, asked.steps, precision)
            held_out = f"dB PSNR to the held-out pictures of {name}"
            said = f"{before:.2f} {held_out} before, {after:.2f} dB after {asked.steps} steps"
            if not after >= before + LEAST_GAIN:
                raise InputError(f"{said}: expected a gain of {LEAST_GAIN} dB; nothing written, keep using {weights}")
            tensors = student.cpu().state_dict()
            write_weights(Weights(written, settings_of(student), motion_of(student), tensors), written)
    print(f"{said}\n{written}: in {duration(perf_counter() - begin)}; for lightning predict --weights {written}")


def clips_and_teacher(
    recording: Recording, student: Network, teacher: str | None, noisy: bool = True
) -> tuple[RecordingClips, str, Network]:
    """Return clips of the recording, the name of the teacher, and the teacher, by default the largest that fits."""
    name = teacher or _largest(recording, student, noisy)
    network = Network.from_pretrained(name)
    for setting in ("scale", "pattern"):
        here, there = student.settings[setting], network.settings[setting]
        if here != there:
            raise UsageError(f"--teacher: expected {setting} {here}, as in --weights, got {there} of {name}")
    frames = max(student.frames, network.frames)
    if recording.frames < ROOM * frames:
        raise ValueError(_too_short(recording, frames))
    clips = RecordingClips(recording, frames, crop_to=student.pattern).in_light(room=recording.frames // ROOM)
    return clips, name, network


def _largest(recording: Recording, student: Network, noisy: bool) -> str:
    """Return the name of the model with most multiplications for this recording, as it should be the best."""
    room = recording.frames // ROOM
    models = list_models(student.scale, student.pattern)
    fit = [one for one in models if one.frames and one.frames <= room]
    if not fit:
        raise ValueError(_too_short(recording, student.frames))
    of_sensor = [one for one in fit if one.noise == noisy] or fit
    return max(of_sensor, key=lambda one: one.macs).name


def _too_short(recording: Recording, frames: int) -> str:
    least = f"at least {ROOM * frames} frames, {ROOM} clips of {frames}"
    return f"{recording.path}: expected {least}, got {recording.frames}"

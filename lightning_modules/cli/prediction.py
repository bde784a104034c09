"""The parts of ``lightning predict`` that other verbs do not have: the choice of weights, pictures and films."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from jsonargparse.typing import PositiveFloat, PositiveInt, restricted_string_type
from pytorch_lightning import Callback
from pytorch_lightning.callbacks import ProgressBar
from pytorch_lightning.cli import LightningArgumentParser

from lightning_modules.cli.arguments import WEIGHTS, behind_configurations, given, options, preset_arguments
from lightning_modules.cli.errors import InputError, UsageError
from lightning_modules.data import RecordingClips
from lightning_modules.inference.presets import SPEEDS, Choice, Preset, choose
from lightning_modules.storage.shipped import list_pretrained
from lightning_modules.tasks.predictions import PictureProgress, Predictions, file_identity, is_film, is_picture
from spikekit import __version__
from spikekit.decoders.methods import DECODERS
from spikekit.io.sidecar import check_unclaimed
from spikekit.timing import duration

NO_RECORDING = "predict: expected a recording: --data Recording --data.path FILE"

_PART = restricted_string_type("Part", r"[1-9]\d{0,5}/[1-9]\d{0,5}")

# how many times as long as its clips a recording is whose first and last pictures a longer clip may cost
_MANY = 10

# dB that longer clips have to be worth to be mentioned where the recording leaves no room for them
_WORTH_ROOM = 0.3

# clocks between two pictures of the network up to which those between, interpolated, lose nothing: in fast scenes, and
# in slower ones
_APART, _FARTHER_APART = 6, 12

# milliseconds a pixel of a picture, written as PNG by one core
_WRITING = 7e-5

# spikes of a white pixel in a clip, below which pictures by a decoder are mostly noise
_ENOUGH = 8


def add_arguments(parser: LightningArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.set_defaults({"return_predictions": False})  # pictures are written; kept, they would fill the memory
    parser.add_argument(
        "--speed",
        choices=list(SPEEDS),
        help="Weights of the package and how they are used: the best; the fastest at most "
        f"{SPEEDS['balanced']:g} dB (balanced) or {SPEEDS['fast']:g} dB (fast) below it, as measured by "
        "lightning trade; the fastest.",
    )
    parser.add_argument(
        "--budget",
        help="Instead, what a frame may take, such as 40ms, 25fps or 200MB: the best that fits, by the same table.",
    )
    parser.add_argument("--fps", type=PositiveFloat, default=25.0, help="Pictures shown in a second of a film.")
    parser.add_argument(
        "--beside",
        choices=list(DECODERS),
        help="Show what this decoder makes of the same spikes to the left of every picture.",
    )
    parser.add_argument(
        "--engine",
        choices=["local", "ray"],
        default="local",
        help="Make the pictures here, or in parts on a Ray cluster, whose nodes see the same files.",
    )
    parser.add_argument(
        "--jobs", type=PositiveInt | None, default=None, help="Parts at once on the cluster; one a GPU, or a node."
    )
    parser.add_argument(
        "--part", type=_PART | None, default=None, help="Make the pictures of part K of N alone, as K/N; no film."
    )


def with_choice(parser: LightningArgumentParser, args: Sequence[str]) -> tuple[list[str], str]:
    """Insert the setting that ``--speed`` or ``--budget`` asks for, and also return a message about it.

    What the choice depends on is read without the parser, which takes as long again: it has its say when all is known,
    and before anything that went wrong here.
    """
    wrong = next((option for _, option, _ in options(args) if option in (*WEIGHTS, "--ckpt_path")), None)
    if wrong:
        raise UsageError(f"--speed and --budget: choose from the weights of the package, got {wrong} as well")
    try:
        preset, said = _choice(args)
    except (OSError, TypeError, ValueError) as error:
        verb, *rest = args
        parser.parse_args([verb, "--config", '{"model": {"network": {"class_path": "CSCSR"}}}', *rest])
        raise (UsageError if isinstance(error, UsageError) else InputError)(str(error)) from error
    return behind_configurations(args, preset_arguments(preset)), said


def _choice(args: Sequence[str]) -> tuple[Preset, str]:
    wishes = {option: value for _, option, value in options(args) if option in ("--speed", "--budget")}
    speed = wishes.get("--speed")
    recording, network = given(args, "data"), given(args, "model.network")
    if not recording.get("path"):
        raise UsageError(NO_RECORDING)
    known = {name: recording[name] for name in ("path", "pattern", "camera", "frame") if name in recording}
    sizes = {name: int(recording[name]) for name in ("height", "width", "every") if name in recording}
    clips, scale = RecordingClips(**known, **sizes), int(network.get("scale", 4))
    every = min((later - clock for clock, later in pairwise(clips.chosen)), default=clips.frames + 1)
    film = every <= clips.frames  # one picture knows the other
    longest = max(clips.frames, _room(clips) if "frame" in known else clips.recording.frames // _MANY)
    white = clips.white  # a second look would read a packed file again
    budget, asked = wishes.get("--budget"), (clips.size, film, longest, white)
    choice = choose(scale, speed, budget, *asked)
    speeds = list(SPEEDS)
    sooner = speeds[max(speeds.index(speed) - 1, 0)] if speed else None
    other = choose(scale, sooner, None, *asked) if sooner else choice
    clips = RecordingClips(**known, **sizes, frames=choice.preset.clip)
    writing = _WRITING * scale**2 * clips.size[0] * clips.size[1]
    took, sooner_took = (
        duration(len(clips) * (one.ms / (_interpolated(one.preset, every, at) + 1) + writing) / 1e3)
        for one, at in ((choice, speed), (other, sooner))
    )
    instead = f"; --speed {sooner}: {sooner_took}, {other.below:.2f} dB below the best" if other != choice else ""
    count = "1 picture" if len(clips) == 1 else f"{len(clips)} pictures"
    said = [str(choice), f"{count}, written as PNG: about {took}{instead}"]
    interpolated = _interpolated(choice.preset, every, speed)
    if interpolated:
        said.append(
            f"{interpolated} of {interpolated + 1} pictures are interpolated, being {every} frames apart; "
            "--model.interpolated 0 makes all by the network"
        )
    preset = replace(choice.preset, interpolated=interpolated or None)
    if speed:
        ideal = choose(scale, speed, None, clips.size, film, clips.recording.frames, white)
        said += _longer(ideal, choice, clips)
    if "calibration" not in recording:
        said += _uncalibrated(preset, clips, scale, film)
    return preset, "\n".join([*said, *_noise(preset, white)])


def _interpolated(preset: Preset, every: int, speed: str | None) -> int:
    """How many pictures between two of the network's follow from these as well."""
    if preset.weights is None or preset.motion == "ZeroFlow":
        return 0
    apart = _APART if speed in (None, "best") else _FARTHER_APART
    return max(apart // every - 1, 0)


def _longer(ideal: Choice, choice: Choice, clips: RecordingClips) -> list[str]:
    """Return a hint where clips at the ends of the recording keep longer ones from being chosen."""
    gain, half = ideal.psnr - choice.psnr, ideal.preset.clip // 2
    if ideal.preset.clip <= choice.preset.clip or gain < _WORTH_ROOM:
        return []
    return [
        f"clips of {ideal.preset.clip} frames would be about {gain:.1f} dB better: --data.frame "
        f"{half}:{clips.recording.frames - half} leaves room for them"
    ]


def _noise(preset: Preset, white: float) -> list[str]:
    """Return a hint where a decoder has too few spikes for a picture, by those of a white pixel in a frame."""
    if not preset.method or (spikes := white * preset.clip) >= _ENOUGH:
        return []
    return [
        f"a white pixel fires {spikes:.1f} times in {preset.clip} frames: a decoder's picture is noisy; --speed fast "
        "and slower ones use a network, which sees less noise"
    ]


def _uncalibrated(preset: Preset, clips: RecordingClips, scale: int, film: bool) -> list[str]:
    """Return a hint where a network sees a camera whose pixels nobody measured; a simulator says its alpha."""
    if preset.method or clips.recording.alpha is not None or clips.recording.calibration is not None:
        return []
    noisy = [weights for weights in list_pretrained(scale) if "noisy" in weights.name]
    fit = [weights for weights in noisy if weights.frames <= preset.clip and weights.film <= film]
    best = max(fit, key=lambda one: (one.frames, one.film), default=None)
    instead = f", or name --model.weights {best.name}" if best else ""
    return [f"no calibration of this sensor: if it is noisy, run spikekit calibrate {clips.recording.path}{instead}"]


def check_output(output: Path, clips: RecordingClips) -> None:
    """Refuse a file for several pictures, and one that the recording needs.

    Raises:
        UsageError: which of them it is.
    """
    if is_picture(output) and len(clips) != 1:
        raise UsageError(
            f"-o: expected a folder or a film for {len(clips)} pictures, got {output}; --data.frame chooses one"
        )
    if is_picture(output) or is_film(output):
        try:
            check_unclaimed([output], clips.recording.path)
        except ValueError as error:
            raise UsageError(f"-o: {error}") from error


def _room(clips: RecordingClips) -> int:
    """Return how many frames clips around all frames that are asked for may have."""
    return 2 * min(clips.chosen[0], clips.recording.frames - 1 - clips.chosen[-1]) + 1


def callbacks(
    output: Path, config: dict[str, Any], precision: int | str | None, given: Sequence[Callback]
) -> list[Callback]:
    """Return the callbacks that write pictures and show progress.

    Args:
        output: a folder, a film or a picture.
        config: what was asked for, as plain values.
        precision: of the Trainer.
        given: callbacks that were asked for.
    """
    data = (config.get("data") or {}).get("init_args", {})
    data = {name: value for name, value in data.items() if name not in ("path", "every", "frame")}
    checkpoint = config.get("ckpt_path")
    made_of = {"model": config["model"], "data": data, "precision": precision, "version": __version__}
    made_of["checkpoint"] = checkpoint and file_identity(checkpoint)
    bar = config["trainer"].get("enable_progress_bar") is not False
    bar = bar and not any(isinstance(callback, ProgressBar) for callback in given)
    part = (0, 1)
    if config["part"] is not None:
        number, count = map(int, config["part"].split("/"))
        if number > count:
            raise UsageError(f"--part: expected at most {count} of {count}, got {number}")
        part = number - 1, count
    predictions = Predictions(output, made_of, config["fps"], config["beside"], part)
    return [predictions, PictureProgress()] if bar else [predictions]

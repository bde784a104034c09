"""What ``lightning predict`` has beside the other verbs: the choice of weights, pictures and films."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jsonargparse.typing import PositiveFloat
from pytorch_lightning import Callback
from pytorch_lightning.callbacks import ProgressBar
from pytorch_lightning.cli import LightningArgumentParser

from lightning_modules.cli.arguments import WEIGHTS, behind_configurations, options, preset_arguments
from lightning_modules.cli.errors import InputError, UsageError
from lightning_modules.data import RecordingClips
from lightning_modules.inference.presets import SPEEDS, choose
from lightning_modules.tasks.predictions import PictureProgress, Predictions, file_identity
from spikekit import __version__
from spikekit.decoders.methods import DECODERS
from spikekit.timing import duration

NO_RECORDING = "predict: expected a recording: --data Recording --data.path FILE"

# milliseconds a pixel of a picture, written as PNG by one core
_WRITING = 7e-5


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
        help="Instead, what a frame may take, such as 40ms or 200MB: the best that fits, by the same table.",
    )
    parser.add_argument("--fps", type=PositiveFloat, default=25.0, help="Pictures shown in a second of a film.")
    parser.add_argument(
        "--beside",
        choices=list(DECODERS),
        help="Show what this decoder makes of the same spikes to the left of every picture.",
    )


def with_choice(parser: LightningArgumentParser, args: Sequence[str]) -> list[str]:
    """Put in the setting that ``--speed`` or ``--budget`` asks for, and say which."""
    given = next((option for _, option, _ in options(args) if option in (*WEIGHTS, "--ckpt_path")), None)
    if given:
        raise UsageError(f"--speed and --budget: choose from the weights of the package, got {given} as well")
    verb, *rest = args
    parsed = parser.parse_args([verb, "--config", '{"model": {"network": {"class_path": "CSCSR"}}}', *rest])[verb]
    recording = parsed.data.get("init_args", {})
    if not recording.get("path"):
        raise UsageError(NO_RECORDING)
    try:
        known = ("path", "height", "width", "pattern", "camera")
        clips = RecordingClips(**{name: recording.get(name) for name in (*known, "frame", "every")})
        scale = parsed.model.init_args.network.init_args.scale
        choice = choose(scale, parsed.speed, parsed.budget, clips.size)
        speeds = list(SPEEDS)
        sooner = speeds[max(speeds.index(parsed.speed) - 1, 0)] if parsed.speed else None
        other = choose(scale, sooner, None, clips.size) if sooner else choice
    except (OSError, ValueError) as error:
        raise InputError(str(error)) from error
    print(choice, flush=True)
    writing = _WRITING * scale**2 * clips.size[0] * clips.size[1]
    took, sooner_took = (duration(len(clips) * (one.ms + writing) / 1e3) for one in (choice, other))
    instead = f"; --speed {sooner}: {sooner_took}, {other.below:.2f} dB below the best" if other != choice else ""
    print(f"{len(clips)} pictures, written as PNG: about {took}{instead}", flush=True)
    return behind_configurations(args, preset_arguments(choice.preset))


def callbacks(
    output: Path, config: dict[str, Any], precision: int | str | None, given: Sequence[Callback]
) -> list[Callback]:
    """Return what writes pictures and shows progress.

    Args:
        output: a folder or a film.
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
    predictions = Predictions(output, made_of, config["fps"], config["beside"])
    return [predictions, PictureProgress()] if bar else [predictions]

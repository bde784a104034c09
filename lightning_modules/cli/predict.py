"""The command ``lightning predict``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

from lightning_modules.cli.configured import checkpoint_of, configured_network
from lightning_modules.cli.errors import InputError, UsageError, VerbParser, input_errors
from lightning_modules.cli.folder_lock import check_folder, locked_folder
from lightning_modules.cli.processes import calls_on_ray
from lightning_modules.inference.output import LOCK, Output, is_film, is_picture
from lightning_modules.inference.presets import SPEEDS
from lightning_modules.inference.reconstruct import Reconstruction, reconstruct
from lightning_modules.inference.tiles import TILE, TILE_ON_GPU
from spikekit.arguments import positive, whole
from spikekit.cli import recordings
from spikekit.io.sidecar import check_unclaimed
from spikekit.io.video_output import check_film
from spikekit.progress import progress
from spikekit.timing import duration

_HOW = "tile", "psnr_tolerance", "self_ensemble", "future"


def parser() -> argparse.ArgumentParser:
    """Return the parser of the verb."""
    made = VerbParser(
        prog="lightning predict",
        allow_abbrev=False,
        description="Make pictures of a recording. By default, --speed balanced chooses the weights, those for noisy "
        "sensors if the recording turns out to be noisy. Existing pictures are not made again.",
        epilog="example: lightning predict FILE.dat --height 250 --width 400 --flip -o film.mp4",
    )
    recordings.add_arguments(made)
    add = made.add_argument
    add("-o", "--output", required=True, metavar="OUT", help="folder, film (.mp4, .mov, .mkv, .gif) or .png")
    add(
        "--frame",
        metavar="N|A:B[:STEP]",
        help="spike frames to make pictures of: N, or A to B - 1; default: every 20th",
    )
    add("--white", type=float, help="white level in spikes per frame; default: measured")
    group = made.add_argument_group("network")
    add = group.add_argument
    add(
        "--speed",
        choices=list(SPEEDS),
        help=f"weights of the package: best; the fastest at most {SPEEDS['balanced']:g} dB (balanced) or "
        f"{SPEEDS['fast']:g} dB (fast) below best; fastest",
    )
    add("--budget", help="the best weights within a cost per picture, such as 2s, 25fps or 200MB")
    add(
        "--scale",
        type=whole(1),
        help="super-resolution factor for --speed and --budget; default: 4, or 1 for a grey camera",
    )
    add("--weights", metavar="NAME", help="a name listed by lightning models, a .safetensors or a .ckpt file")
    add("-c", "--config", action="append", default=[], metavar="FILE", help="the network of a configuration")
    add("--ckpt_path", metavar="FILE", help="checkpoint of the configuration; best and last: of its output, or of -o")
    add = made.add_argument_group("inference").add_argument
    sides = f"{TILE}, on a GPU {TILE_ON_GPU}"
    add(
        "--tile",
        type=whole(0),
        metavar="N",
        help=f"largest side of a tile in sensor pixels, 0 for none; default: {sides}",
    )
    add(
        "--tolerance",
        type=float,
        dest="psnr_tolerance",
        metavar="DB",
        help="films: PSNR in dB that a picture may lose to save work; above 0, the network runs only where the spikes "
        "show motion, and less often where it is slow; default: 0.1 for --speed fast and balanced, or else 0",
    )
    add("--self_ensemble", type=int, metavar="N", help="average 2, 4 or 8 views of a clip")
    add("--future", type=whole(0), metavar="N", help="later pictures that a picture waits for; weights for films only")
    add("--device", help="such as cpu or cuda:1; default: a GPU if there is one")
    add("--precision", choices=["32-true", "bf16-mixed"], help="default: bf16-mixed if the device supports it")
    add = made.add_argument_group("output").add_argument
    add("--fps", type=positive, default=25.0, help="pictures per second of a film; default: 25")
    add("--beside", choices=("tfi", "tfp"), help="also show the picture of this decoder, to the left of every picture")
    add("--engine", choices=["local", "ray"], default="local", help="this machine, or a Ray cluster; default: local")
    add("--jobs", type=whole(1), help="parts at once on the cluster; default: one per GPU, or per node")
    return made


def predict(args: Sequence[str]) -> None:
    """Run ``lightning predict`` with the given arguments."""
    asked, begin = parser().parse_args(args), perf_counter()
    output = Path(asked.output).expanduser()
    if is_film(output):
        check_film(output)
    if not is_film(output) and not is_picture(output):
        check_folder(output)
    arguments = _arguments(asked, output)
    with input_errors():
        pictures = reconstruct(asked.file, **arguments)
        _check_output(output, pictures)
    for line in pictures.notes:
        print(line, flush=True)
    there = Output(output, pictures.clips.chosen, {**pictures.identity(), "beside": asked.beside})
    with locked_folder(there.folder, "lightning predict", LOCK):
        before = there.made()
        if asked.engine == "ray":
            _on_ray(asked, arguments, output)
        else:
            _make(pictures, there, before, asked.beside)
        there.finish(asked.fps)
    there.clear()
    total, new = len(pictures), len(pictures) - len(before)
    said = f"{total} {'picture' if total == 1 else 'pictures'}" + (f", {new} new" if before else "")
    took = perf_counter() - begin
    each = f" ({duration(took / new)} each)" if new > 1 else ""
    print(f"{output}: {said}, in {duration(took)}{each}; white level {pictures.white:.4g} spikes per frame")


def _arguments(asked: argparse.Namespace, output: Path) -> dict[str, Any]:
    """Return the arguments of :func:`lightning_modules.reconstruct`."""
    own = {"--weights": asked.weights, "-c": asked.config, "--ckpt_path": asked.ckpt_path}
    named = [option for option, value in own.items() if value]
    chosen = [option for option in ("speed", "budget") if getattr(asked, option) is not None]
    if named and chosen:
        raise UsageError(f"--{chosen[0]}: chooses weights of the package, got {named[0]} as well")
    names = ("speed", "budget", "scale", "frame", "white", "device", "precision")
    arguments = {name: getattr(asked, name) for name in names} | recordings.known(asked)
    if named:
        checkpoint = checkpoint_of(asked.ckpt_path, asked.config, output)
        arguments["network"] = configured_network(asked.config, asked.weights, checkpoint)
    return arguments | {name: getattr(asked, name) for name in _HOW if getattr(asked, name) is not None}


def _check_output(output: Path, pictures: Reconstruction) -> None:
    """Check that a single file is not to take several pictures, and is no file of the recording."""
    if is_picture(output) and len(pictures) != 1:
        several = f"a folder or a film for {len(pictures)} pictures"
        raise UsageError(f"-o: expected {several}, got {output}; --frame chooses one")
    if is_picture(output) or is_film(output):
        try:
            check_unclaimed([output], pictures.clips.recording.path)
        except ValueError as error:
            raise UsageError(f"-o: {error}") from error


def _make(
    pictures: Reconstruction, there: Output, made: set[int], beside: str | None, part: tuple[int, int] = (0, 1)
) -> None:
    """Make the missing pictures, with a progress bar on a terminal and one line per picture elsewhere."""
    left = len(pictures) - len(made)
    with progress(what="pictures", total=left, unit="picture", delay=0) as bar:
        new = pictures.pictures(made, part, beside, Path(f"{there.state}.{part[0]}"))
        for number, (frame, rgb) in enumerate(new, 1):
            path = there.write(frame, rgb)
            bar.update()
            if not sys.stderr.isatty():
                print(f"{path}, {number} of {left}", flush=True)


def _on_ray(asked: argparse.Namespace, arguments: dict[str, Any], output: Path) -> None:
    if asked.budget is not None:
        raise UsageError("--engine ray: expected --speed or --weights, got --budget, which differs by node")

    def calls(parts: int) -> dict[str, tuple[Any, ...]]:
        settings = (asked.file.resolve(), arguments, output.resolve(), asked.beside)
        return {f"part {n + 1} of {parts}": (_make_part, *settings, (n, parts)) for n in range(parts)}

    for ended in calls_on_ray(calls, asked.jobs):
        for name, reason in ended.items():
            if reason is not None:
                raise InputError(f"predict: {name}: {reason}")
            print(f"{name} is made", flush=True)


def _make_part(file: Path, arguments: dict[str, Any], output: Path, beside: str | None, part: tuple[int, int]) -> None:
    """Make a part of the pictures in a process of a cluster."""
    pictures = reconstruct(file, **arguments)
    there = Output(output, pictures.clips.chosen, {**pictures.identity(), "beside": beside})
    _make(pictures, there, there.made(), beside, part)

"""The ``spikekit`` command: look into recordings and turn them into pictures."""

from __future__ import annotations

import argparse
import inspect
import io
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from spikekit import __version__, bench, extremes
from spikekit.arguments import FRAMES, UsageError, frames_of, one_line, positive, whole
from spikekit.cli import calibrate as calibrate_cli
from spikekit.cli import simulate as simulate_cli
from spikekit.cli import view as view_cli
from spikekit.color.cfa import PATTERNS
from spikekit.color.demosaic import demosaic
from spikekit.decoders.methods import DECODERS, TFI_REACH
from spikekit.io.files import iter_spikes
from spikekit.io.images import write_picture
from spikekit.io.recording import Recording, add_arguments, add_calibration, open_recording, white_rate
from spikekit.io.sidecar import check_unclaimed
from spikekit.io.video import PICTURE_ENDINGS

#: Clocks a second of the cameras.
CLOCK_HZ = 20_000

#: Frames that TFP averages when nothing else is said.
TFP_WINDOW = 41

# Gives the frame of a number, its pixels unpacked.
_Plane = Callable[[int], np.ndarray]

# Stands for the number of the frame in the name of a picture.
_NUMBER = "{frame}"

# Pixels that are counted at a time.
_BLOCK = 1 << 24


def info(args: argparse.Namespace) -> None:
    """Print what a recording holds, in one pass over its frames."""
    recording = open_recording(args)
    frames, (height, width) = recording.frames, recording.size
    counts = _counts(recording, 0, frames)
    pixels, spikes = counts.numel(), int(counts.sum())
    rates = counts.double() / frames
    dead, full = int((counts == 0).sum()), int((counts == frames).sum())
    packed = args.file.suffix.lower() == ".dat"
    print(f"file         {args.file}")
    print(f"format       {'.dat, 8 pixels a byte, no header' if packed else '.npz, an array of zeros and ones'}")
    print(f"size         {height} x {width} (H x W), {args.file.stat().st_size} bytes")
    print(f"frames       {frames}, {1e3 * frames / CLOCK_HZ:g} ms at {CLOCK_HZ // 1000} kHz")
    print(f"bits set     {spikes} of {pixels * frames}, {spikes / (pixels * frames):.2%}")
    print(f"median       {rates.median():.4f} spikes a frame")
    print(f"darkest      {_at(rates, rates.argmin())}")
    print(f"brightest    {_at(rates, rates.argmax())}")
    print(f"never fire   {dead} of {pixels} pixels, {dead / pixels:.2%}")
    print(f"always fire  {full} of {pixels} pixels, {full / pixels:.2%}")
    if recording.calibration is not None:
        known = recording.calibration
        bad = int((known.defects != 0).sum())
        print(f"calibration  gains {known.gain.std():.2%} apart, dark {known.dark.median():.2g} a frame, {bad} defects")


def decode(args: argparse.Namespace) -> None:
    """Write the picture of one frame, or of many, reading only as much around each as the method needs."""
    decoder = DECODERS[args.method]
    if args.window is not None and ("window" not in decoder.options or args.window % 2 == 0):
        methods = _with_option("window")
        raise UsageError(f"--window: expected an odd number, with {methods}, got {args.window} with {args.method}")
    if args.order > 1 and "order" not in decoder.options:
        raise UsageError(f"--order: expected {_with_option('order')}, got {args.order} with {args.method}")
    if args.output.is_dir():
        raise ValueError(f"{args.output}: expected a picture to write, got a folder")
    recording = open_recording(args)
    frames = recording.frames
    chosen = _chosen(args, frames)
    if len(chosen) > 1 and _NUMBER not in str(args.output):
        raise UsageError(f"--output: expected {_NUMBER} in the name of {len(chosen)} pictures, got {args.output}")
    if args.order > frames:
        raise UsageError(f"--order: expected 1 .. {frames}, as {args.file} has {frames} frames, got {args.order}")

    paths = {n: Path(str(args.output).replace(_NUMBER, f"{n:0{len(str(frames - 1))}}")) for n in chosen}
    check_unclaimed(paths.values(), args.file)

    given = {**vars(args), "window": args.window or TFP_WINDOW}
    options = {name: given[name] for name in decoder.options}
    reach = decoder.reach(**options)
    key = chosen[len(chosen) // 2]
    alpha = args.alpha or recording.alpha
    white, scaling = _white(alpha, recording, key, reach)
    scaling += recording.said
    hidden = True if len(chosen) == 1 else None  # None: on a terminal only
    for n, plane in tqdm(_windows(recording, chosen, reach), "pictures", len(chosen), disable=hidden, leave=False):
        first, last = _span(n, reach, frames)
        raw = torch.from_numpy(decoder.planes(plane, n, range(first, last + 1), frames, **options))
        raw = recording.correct(raw) / white
        picture = raw if recording.pattern is None else demosaic(raw, recording.pattern)
        _write(paths[n], recording.show(picture, known=alpha is not None))
    if len(chosen) == 1:
        first, last = _span(key, reach, frames)
        print(f"{paths[key]}: frame {key} of {frames} by {args.method} from frames {first} .. {last}, {scaling}")
    else:
        print(
            f"{args.output}: {len(chosen)} pictures of frames {chosen[0]} .. {chosen[-1]} of {frames}, {chosen.step} "
            f"apart, by {args.method} from up to {reach} frames on each side, all {scaling}"
        )


def _with_option(name: str) -> str:
    return f"--method {' or '.join(method for method, decoder in DECODERS.items() if name in decoder.options)}"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return 0, 1 for a file that cannot be used, or 2 for a command line that cannot."""
    try:
        with suppress(SystemExit):  # --help
            args = _parser().parse_args(argv)
            args.run(args)
        print(end="", flush=True)
    except (ValueError, MemoryError) as error:
        print(f"spikekit: {one_line(error)}", file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1
    except OSError as error:
        if error.filename is not None:
            print(f"spikekit: {error.filename}: {one_line(error)}", file=sys.stderr)
            return 1
        # nobody reads what is printed, or it finds no room: Python would complain when it flushes at exit
        with suppress(io.UnsupportedOperation):  # what is printed goes to no file
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            return 141
        print(f"spikekit: standard output: {one_line(error)}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} (see {self.prog} --help)")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="spikekit", description="Look into spike recordings and turn them into pictures.")
    parser.add_argument("--version", action="version", version=f"spikekit {__version__}")
    verbs = parser.add_subparsers(title="verbs", metavar="VERB", required=True)

    verb = _add_verb(verbs, info, "info", "what a recording holds", "info street.dat --height 250 --width 400")
    add_arguments(verb)
    add_calibration(verb)

    verb = _add_verb(
        verbs,
        decode,
        "decode",
        "the picture of one frame, or of many",
        "decode water.dat --height 1000 --width 1000 --flip --pattern BGGR --method tfi -o water.png",
    )
    add_arguments(verb)
    add_calibration(verb)
    verb.add_argument(
        "--method",
        required=True,
        choices=DECODERS,
        help="by the interval between the two spikes around the frame, or by the number of spikes in a window around "
        f"it; tfi looks up to {TFI_REACH} frames to each side, and a pixel with no spike there is taken to have fired "
        "just outside",
    )
    verb.add_argument(
        "-o",
        "--output",
        required=True,
        type=_picture,
        metavar="OUT.png",
        help=f"the picture to write; {_NUMBER} in it becomes the number of the frame, with leading zeros",
    )
    verb.add_argument(
        "--pattern", type=str.upper, choices=PATTERNS, help="Bayer phase after the flip, for colour; grey without it"
    )
    verb.add_argument(
        "--frame",
        type=_frames,
        metavar="N|A:B[:STEP]",
        help="which frame, from 0, or which frames, from A to B - 1, as in Python; the middle one if not given",
    )
    verb.add_argument(
        "--window",
        type=whole(1),
        metavar="W",
        help=f"frames that tfp averages, odd, the frame in their middle, fewer at the ends of the recording; "
        f"{TFP_WINDOW} if not given",
    )
    verb.add_argument(
        "--order",
        type=whole(1),
        default=1,
        metavar="K",
        help="how often tfp takes the mean: --window 13 --order 3 sees 37 frames, with less noise and less blur than a "
        "window of 37; 1 if not given",
    )
    verb.add_argument(
        "--alpha",
        type=positive,
        metavar="A",
        help="gain of a simulated recording (a white pixel fires A times a frame), to divide by; "
        "if not given, the picture is scaled until the 99.9th percentile of the spike rate in the frames it is made "
        "from is white, and many pictures all as the one in their middle",
    )

    example = "simulate walk -o walk.dat --scale 4"
    simulate_cli.add_arguments(_add_verb(verbs, simulate_cli.run, "simulate", "a stream of a film", example))
    example = "calibrate street.dat --height 250 --width 400 --flat wall.dat --dark cap.dat"
    calibrate_cli.add_arguments(_add_verb(verbs, calibrate_cli.run, "calibrate", "gain and defects of pixels", example))
    example = "view walk.dat -o walk.html"
    view_cli.add_arguments(_add_verb(verbs, view_cli.run, "view", "a recording as a picture or a page", example))
    example = "extremes --operator tfi --markdown"
    extremes.add_arguments(_add_verb(verbs, extremes.run, "extremes", "how exact the operators are at worst", example))
    example = "bench tfi tfp --size small"
    bench.add_arguments(_add_verb(verbs, bench.run, "bench", "how fast the operators are beside others", example))
    return parser


def _add_verb(verbs: Any, run: Any, name: str, summary: str, example: str) -> argparse.ArgumentParser:
    verb = verbs.add_parser(
        name,
        help=summary,
        description=inspect.getdoc(run),
        epilog=f"example:\n  spikekit {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    verb.set_defaults(run=run)
    return verb


def _frames(text: str) -> str:
    if not re.fullmatch(FRAMES, text, re.ASCII):
        raise argparse.ArgumentTypeError(f"expected a whole number, 0 or more, or A:B or A:B:STEP, got {text}")
    return text


def _picture(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() not in PICTURE_ENDINGS:  # the picture library would write TIFF, over a recording as well
        raise argparse.ArgumentTypeError(f"expected a picture that ends in {', '.join(PICTURE_ENDINGS)}, got {text}")
    return path


def _chosen(args: argparse.Namespace, frames: int) -> range:
    """Return the frames to decode."""
    text = str(frames // 2) if args.frame is None else args.frame
    try:
        return frames_of(text, 0, frames - 1)
    except ValueError as error:
        said = f"expected 0 .. {frames - 1}, as {args.file} has {frames} frames, got {text}"
        raise UsageError(f"--frame: {said}") from error


def _white(alpha: float | None, recording: Recording, key: int, reach: int) -> tuple[float, str]:
    """Return what becomes white, and a sentence that says so."""
    if alpha is not None:
        return alpha, f"divided by alpha {alpha:g}"
    first, last = _span(key, reach, recording.frames)
    # Of the rate, not of the picture: TFI makes 1 or 1/2 of a bright pixel, and its percentile is one of the two.
    white = white_rate(recording.correct(_counts(recording, first, last - first + 1) / (last - first + 1)))
    scale = f"multiplied by {1 / white:.4g}"
    return white, f"{scale}, so that the 99.9th percentile of the spike rate around frame {key} is white"


def _span(frame: int, reach: int, frames: int) -> tuple[int, int]:
    """Return the first and the last frame that the picture of one is made from."""
    return max(frame - reach, 0), min(frame + reach, frames - 1)


def _windows(recording: Recording, chosen: range, reach: int) -> Iterator[tuple[int, _Plane]]:
    """Read forwards; yield every chosen frame and what unpacks it and its neighbours."""
    path, frames, (height, width) = recording.path, recording.frames, recording.stored
    held = np.empty((min(2 * reach + 1, frames), height, -(-width // 8)), np.uint8)  # frame n at n modulo the length

    def plane(n: int) -> np.ndarray:
        return recording.unpack(held[n % len(held)])

    stream, stop = None, 0
    for n in chosen:
        first, last = _span(n, reach, frames)
        if stream is None or (stop < first and path.suffix.lower() == ".dat"):  # an .npz has no short cut
            stream = iter_spikes(path, height, width, flip=recording.flip, start=first, packed=True)
            stop = first
        for k in range(stop, last + 1):
            held[k % len(held)] = next(stream).numpy()
        stop = last + 1
        yield n, plane


def _counts(recording: Recording, start: int, frames: int) -> Tensor:
    """Count the spikes of every pixel in some frames."""
    height, width = recording.stored
    counts = torch.zeros(height, width, dtype=torch.int64)
    chunk = min(max(_BLOCK // (height * width), 1), 255)  # whose sum fits into a byte
    parts = iter_spikes(recording.path, height, width, flip=recording.flip, start=start, frames=frames, chunk=chunk)
    for part in parts:
        counts += torch.from_numpy(part.numpy().sum(axis=0, dtype=np.uint8))
    return recording.prepare(counts)


def _write(path: Path, picture: Tensor) -> None:
    """Write a picture; what is wrong is said in one line."""
    try:
        write_picture(path, picture)
    except Exception as error:  # what a picture library raises depends on the ending
        raise ValueError(f"{path}: cannot be written ({one_line(error)})") from error


def _at(rates: Tensor, index: Tensor) -> str:
    row, column = divmod(int(index), rates.shape[-1])
    return f"{rates.flatten()[index]:.4f} spikes a frame, at row {row}, column {column}"

"""The ``spikekit`` command: look into recordings and turn them into pictures."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from spikekit.cfa import PATTERNS
from spikekit.decoders import tfi, tfp
from spikekit.demosaic import demosaic
from spikekit.files import iter_spikes, read_spikes, spikes_shape
from spikekit.pictures import write_picture

#: Clocks a second of the cameras.
CLOCK_HZ = 20_000

#: (height, width) of what the field's headerless recordings come from.
USUAL_SIZES = {
    (250, 400): "grey Vidar camera",
    (250, 416): "grey Vidar camera, 16 columns of header",
    (250, 250): "UHSR",
    (1000, 1000): "colour spike camera",
    (1000, 1024): "colour spike camera, PCIe stream",
}

#: Frames that TFI looks at on each side; a pixel that fires more rarely is decoded as if it fired once in all of them.
TFI_REACH = 200

#: Frames that TFP averages when nothing else is said.
TFP_WINDOW = 41

_PICTURE_ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")

# Rows decoded at a time: the decoders give every frame of the span, of which one is kept.
_BAND = 32


class UsageError(ValueError):
    """A command line that asks for what cannot be."""


def info(args: argparse.Namespace) -> None:
    """Print what a recording holds, in one pass over its frames."""
    _check_size_given(args)
    frames, height, width = spikes_shape(args.file, args.height, args.width)
    counts = torch.zeros(height, width, dtype=torch.int64)
    for frame in iter_spikes(args.file, args.height, args.width, flip=args.flip):
        counts += frame

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


def decode(args: argparse.Namespace) -> None:
    """Write the picture of one frame, reading only as much around it as the method needs."""
    _check_size_given(args)
    if args.window is not None and (args.method != "tfp" or args.window % 2 == 0):
        raise UsageError(f"--window: expected an odd number, with --method tfp, got {args.window} with {args.method}")
    if args.output.is_dir():
        raise ValueError(f"{args.output}: expected a picture to write, got a folder")
    frames, _, _ = spikes_shape(args.file, args.height, args.width)
    frame = frames // 2 if args.frame is None else args.frame
    if frame >= frames:
        raise UsageError(f"--frame: expected 0 .. {frames - 1}, as {args.file} has {frames} frames, got {frame}")

    window = args.window or TFP_WINDOW
    reach = window // 2 if args.method == "tfp" else TFI_REACH
    first, last = max(frame - reach, 0), min(frame + reach, frames - 1)
    spikes = read_spikes(args.file, args.height, args.width, flip=args.flip, start=first, frames=last - first + 1)
    raws, rates = [], []
    for band in spikes.split(_BAND, dim=-2):
        decoded = tfp(band, window) if args.method == "tfp" else tfi(band)
        raws.append(decoded[frame - first].clone())  # a view would keep the whole span
        rates.append(band.numpy().mean(axis=0, dtype=np.float32))
    raw, rate = torch.cat(raws), np.concatenate(rates)

    if args.alpha is None:
        # Of the rate, not of the picture: TFI makes 1 or 1/2 of a bright pixel, and its percentile is one of the two.
        white = float(np.quantile(rate, 0.999)) or float(rate.max()) or 1.0
        scaling = f"multiplied by {1 / white:.4g}, so that the 99.9th percentile of the spike rate is white"
    else:
        white = args.alpha
        scaling = f"divided by alpha {white:g}"
    picture = raw / white if args.pattern is None else demosaic(raw / white, args.pattern)
    try:
        write_picture(args.output, picture)
    except Exception as error:  # what a picture library raises depends on the ending
        raise ValueError(f"{args.output}: cannot be written ({_one_line(error)})") from error
    print(f"{args.output}: frame {frame} of {frames} by {args.method} from frames {first} .. {last}, {scaling}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return 0, 1 for a file that cannot be used, or 2 for a command line that cannot."""
    try:
        with suppress(SystemExit):  # --help
            args = _parser().parse_args(argv)
            args.run(args)
        print(end="", flush=True)
    except (ValueError, MemoryError) as error:
        print(f"spikekit: {_one_line(error)}", file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1
    except OSError as error:  # nobody reads what is printed, or it finds no room
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains when it flushes at exit
        if isinstance(error, BrokenPipeError):
            return 141
        print(f"spikekit: standard output: {_one_line(error)}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} (see {self.prog} --help)")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="spikekit", description="Look into spike recordings and turn them into pictures.")
    verbs = parser.add_subparsers(title="verbs", metavar="VERB", required=True)

    verb = _add_verb(verbs, info, "info", "what a recording holds", "info street.dat --height 250 --width 400")
    _add_recording(verb)

    verb = _add_verb(
        verbs,
        decode,
        "decode",
        "the picture of one frame",
        "decode water.dat --height 1000 --width 1000 --flip --pattern BGGR --method tfi -o water.png",
    )
    _add_recording(verb)
    verb.add_argument(
        "--method",
        required=True,
        choices=("tfi", "tfp"),
        help=f"by the interval between spikes (reads {TFI_REACH} frames on each side), or by their number in a window",
    )
    verb.add_argument("-o", "--output", required=True, type=_picture, metavar="OUT.png", help="the picture to write")
    verb.add_argument(
        "--pattern", type=str.upper, choices=PATTERNS, help="Bayer phase after the flip, for colour; grey without it"
    )
    verb.add_argument("--frame", type=_whole(0), metavar="N", help="which frame, from 0; the middle one if not given")
    verb.add_argument(
        "--window", type=_whole(1), metavar="W", help=f"frames that tfp averages, odd; {TFP_WINDOW} if not given"
    )
    verb.add_argument(
        "--alpha",
        type=_positive,
        metavar="A",
        help="gain of a simulated recording (a white pixel fires A times a frame), to divide by; "
        "if not given, the picture is scaled until the 99.9th percentile of the spike rate is white",
    )
    return parser


def _add_verb(verbs: Any, run: Any, name: str, summary: str, example: str) -> argparse.ArgumentParser:
    verb = verbs.add_parser(
        name,
        help=summary,
        description=run.__doc__,
        epilog=f"example:\n  spikekit {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    verb.set_defaults(run=run)
    return verb


def _add_recording(verb: argparse.ArgumentParser) -> None:
    verb.add_argument("file", type=Path, metavar="FILE", help="a recording, .dat (8 pixels a byte, no header) or .npz")
    verb.add_argument("--height", type=_whole(1), metavar="H", help="rows of a frame; a .dat needs it")
    verb.add_argument("--width", type=_whole(1), metavar="W", help="columns of a frame; a .dat needs it")
    verb.add_argument("--flip", action="store_true", help="the frames are stored upside down, as real cameras do")


def _whole(least: int) -> Any:
    def whole(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            number = least - 1
        if number < least:
            raise argparse.ArgumentTypeError(f"expected a whole number, {least} or more, got {text}")
        return number

    return whole


def _positive(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text}")
    return number


def _picture(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() not in _PICTURE_ENDINGS:  # the picture library would write TIFF, over a recording as well
        raise argparse.ArgumentTypeError(f"expected a picture that ends in {', '.join(_PICTURE_ENDINGS)}, got {text}")
    return path


def _check_size_given(args: argparse.Namespace) -> None:
    """Raise where a headerless file comes without its size, and help to find it."""
    path = args.file
    if path.suffix.lower() != ".dat" or not path.is_file() or None not in (args.height, args.width):
        return
    size = path.stat().st_size
    fits = {}
    for (height, width), camera in USUAL_SIZES.items():
        frames, rest = divmod(size, -(-height * width // 8))
        if frames and not rest:
            fits[height, width] = f"{height} x {width} ({camera}: {frames} frames)"
    sizes = " and ".join(fits.values()) or f"none of {', '.join(f'{h} x {w}' for h, w in USUAL_SIZES)}"
    raise UsageError(
        f"{path}: a .dat has no header, give --height and --width; of the usual sizes (H x W), "
        f"{sizes} divide{'' if len(fits) > 1 else 's'} its {size} bytes exactly"
    )


def _at(rates: Tensor, index: Tensor) -> str:
    row, column = divmod(int(index), rates.shape[-1])
    return f"{rates.flatten()[index]:.4f} spikes a frame, at row {row}, column {column}"


def _one_line(error: BaseException) -> str:
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(text.split())

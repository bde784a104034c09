"""``spikekit decode``: write pictures of the frames of a recording."""

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch

from spikekit.arguments import UsageError, ending_in, frames_of, positive, whole
from spikekit.cli import recordings
from spikekit.color.demosaic import demosaic
from spikekit.decoders.single_frame import search, tfp_weights
from spikekit.io.images import write_picture
from spikekit.io.sidecar import check_unclaimed
from spikekit.io.video import PICTURE_ENDINGS
from spikekit.progress import progress
from spikekit.recording import Recording, white_rate
from spikekit.standard_output import say

#: Default window of TFP, in frames.
TFP_WINDOW = 41

#: Frames that TFI looks at on each side; a pixel that fires more rarely is decoded as if it fired once in all of them.
TFI_REACH = 200

# Returns the unpacked frame of a given number.
_Plane = Callable[[int], np.ndarray]

# Placeholder of the frame number in the name of a picture.
_NUMBER = "{frame}"


def run(args: argparse.Namespace) -> None:
    """Write pictures of one or more frames, reading only the neighbouring frames that the method needs."""
    if args.method is None:
        args.method = "tfi" if args.window is None and args.order == 1 else "tfp"
    window = args.window or TFP_WINDOW
    if window % 2 == 0 or (args.window and args.method == "tfi"):
        raise UsageError(f"--window: expected an odd number, with --method tfp, got {window} with {args.method}")
    if args.order > 1 and args.method == "tfi":
        raise UsageError(f"--order: expected --method tfp, got {args.order} with tfi")
    recording = recordings.opened(args)
    frames = recording.frames
    chosen = frames_of("--frame", str(frames // 2) if args.frame is None else args.frame, 0, frames - 1)
    if len(chosen) > 1 and _NUMBER not in str(args.output):
        raise UsageError(f"--output: expected {_NUMBER} in the name of {len(chosen)} pictures, got {args.output}")
    if args.order > frames:
        raise UsageError(f"--order: expected 1 .. {frames}, as {args.file} has {frames} frames, got {args.order}")

    paths = {n: Path(str(args.output).replace(_NUMBER, f"{n:0{len(str(frames - 1))}}")) for n in chosen}
    check_unclaimed(paths.values(), args.file)

    reach = TFI_REACH if args.method == "tfi" else args.order * (window // 2)
    key = chosen[len(chosen) // 2]
    alpha = args.alpha or recording.alpha
    white, scaling = _white(alpha, recording, key, reach)
    scaling += recording.said
    for n, plane in progress(_windows(recording, chosen, reach), "pictures", len(chosen)):
        first, last = _span(n, reach, frames)
        seen = range(first, last + 1)
        if args.method == "tfi":
            light = np.reciprocal(search(plane, n, seen), dtype=np.float32)
        else:
            _, weights = tfp_weights(frames, n, window, args.order)
            light = sum(map(np.multiply, map(plane, seen), weights)).astype(np.float32)
        raw = recording.correct(torch.from_numpy(light)) / white
        picture = raw if recording.bayer is None else demosaic(raw, recording.bayer)
        picture = recording.show(picture, known=alpha is not None)
        write_picture(paths[n], picture, bits=args.bits, quality=args.quality)
    what = f"frame {key}" if len(chosen) == 1 else f"{len(chosen)} pictures of frames {chosen[0]} .. {chosen[-1]}"
    say(f"{args.output}: {what} of {frames} by {args.method} from up to {reach} frames on each side, {scaling}")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    recordings.add_arguments(parser)
    add = parser.add_argument
    add(
        "--method",
        choices=("tfi", "tfp"),
        help="tfi: from the interval between the two spikes around the frame, which adapts to dim and bright pixels; "
        f"it searches up to {TFI_REACH} frames on each side, and assumes a spike just outside if it finds none. "
        "tfp: from the number of spikes in a window around the frame. Default: tfp if --window or --order is given, "
        "else tfi",
    )
    add(
        "-o",
        "--output",
        required=True,
        # for any other ending the library would write TIFF, even over a recording
        type=ending_in(*PICTURE_ENDINGS, said=f"a picture that ends in {', '.join(PICTURE_ENDINGS)}"),
        metavar="OUT.png",
        help=f"picture to write; {_NUMBER} stands for the number of the frame, with leading zeros",
    )
    add("--bits", type=int, choices=(8, 16), default=8, help="bits per channel of a .png or .tif; default: 8")
    add("--quality", type=whole(1), metavar="Q", help="quality of a .jpg, 1 to 100")
    add(
        "--frame",
        metavar="N|A:B[:STEP]",
        help="frame, counted from 0, or frames A to B - 1, as in Python; default: the middle frame",
    )
    add(
        "--window",
        type=whole(1),
        metavar="W",
        help="window of tfp in frames, odd, centred on the frame and cut at the ends of the recording; "
        f"default: {TFP_WINDOW}",
    )
    add(
        "--order",
        type=whole(1),
        default=1,
        metavar="K",
        help="how many times tfp averages: --window 13 --order 3 sees 37 frames, with less noise and less blur than a "
        "window of 37; default: 1",
    )
    add(
        "--alpha",
        type=positive,
        metavar="A",
        help="spikes per frame of a white pixel, the gain of a simulated recording; the picture is divided by it. "
        "Default: that of the side-car, else the 99.9th percentile of the spike rate around the frame; several "
        "pictures share the value of the middle one",
    )


def _white(alpha: float | None, recording: Recording, key: int, reach: int) -> tuple[float, str]:
    """Return the white level, and a description of it."""
    if alpha is not None:
        return alpha, f"divided by alpha {alpha:g}"
    first, last = _span(key, reach, recording.frames)
    # The percentile of the rate, not of the picture: a bright pixel of TFI is 1 or 1/2, and so is its percentile.
    rates = recording.counts(first, last - first + 1) / (last - first + 1)
    white = white_rate(recording.correct(rates), recording.bayer)
    scale = f"multiplied by {1 / white:.4g}"
    return white, f"{scale}, so that the 99.9th percentile of the spike rate around frame {key} is white"


def _span(frame: int, reach: int, frames: int) -> tuple[int, int]:
    """Return the first and the last frame that contribute to a picture."""
    return max(frame - reach, 0), min(frame + reach, frames - 1)


def _windows(recording: Recording, chosen: range, reach: int) -> Iterator[tuple[int, _Plane]]:
    """Yield every chosen frame and a function that unpacks it and its neighbours, reading forwards only."""
    frames, stop = recording.frames, 0
    held: deque[np.ndarray] = deque(maxlen=min(2 * reach + 1, frames))  # packed frames, the last is stop - 1
    stream = recording.packed(0, frames)

    def plane(n: int) -> np.ndarray:
        return recording.unpack(held[n - stop])

    for n in chosen:
        first, last = _span(n, reach, frames)
        if stop < first and recording.path.suffix.lower() == ".dat":  # an .npz cannot seek
            stream, stop = recording.packed(first, frames - first), first
        while stop <= last:
            held.append(next(stream))
            stop += 1
        yield n, plane

"""``spikekit view``: a recording as a sheet of pictures."""

from __future__ import annotations

import argparse
import io
import math
import re

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.arguments import UsageError, ending_in, positive, whole
from spikekit.cli import recordings
from spikekit.color.demosaic import demosaic
from spikekit.decoders.single_frame import search
from spikekit.flow.fields import upsample_flow
from spikekit.io.images import flow_to_rgb
from spikekit.io.sidecar import check_unclaimed
from spikekit.io.whole_file import whole_file
from spikekit.recording import Recording, white_rate
from spikekit.standard_output import say

#: Frames on each side of the one in the middle that are looked at.
REACH = 200

_WINDOW = 41
_FEW, _ENOUGH = 4, 8  # spikes of a pixel in a window: below the one there is a hint at a window of the other


def run(args: argparse.Namespace) -> None:
    """Draw a sheet about one moment of a recording.

    It shows decoded pictures, spikes over time, how often pixels fire, and what moves. Only the frames that are shown
    are read. For pictures over time, see spikekit decode.

    Size, Bayer phase and brightness can be omitted if a side-car or --camera gives them.
    """
    shown = recordings.opened(args)
    begin, end = _span(args.frames, shown)
    check_unclaimed([args.output], args.file)
    if args.row is not None and args.row >= shown.size[0]:
        raise UsageError(f"--row: expected 0 .. {shown.size[0] - 1}, got {args.row}")
    moment = Moment(shown, begin, end, args.window or _WINDOW, args.alpha or shown.alpha, args.row)
    data = moment.sheet()
    with whole_file(args.output) as file:
        file.write(data)
    white = f"alpha {moment.alpha:g} is white" if moment.alpha else f"{moment.white:.3g} spikes a frame are white"
    say(f"{args.output}: frames {begin} .. {end - 1} of {shown.frames}, {white}{shown.said}")
    if moment.hint and not args.window:
        print(moment.hint)


class Moment:
    """Frames of a recording, from ``begin`` to before ``end``, and what can be seen around the one in their middle.

    ``window`` is how many frames TFP averages, ``alpha`` the light of a white pixel, where it is known, ``row`` the one
    whose spikes are drawn, the middle one when not given.
    """

    def __init__(
        self, recording: Recording, begin: int, end: int, window: int, alpha: float | None, row: int | None
    ) -> None:
        self.recording, self.alpha = recording, alpha
        self.row = recording.size[0] // 2 if row is None else row
        self.frame = frame = (begin + end) // 2
        self.near = near = range(max(begin, frame - REACH), min(end, frame + REACH + 1))
        first = max(near.start, frame - min(window, end - begin) // 2)
        self.averaged = range(first, min(first + window, near.stop))
        self._planes = list(recording.packed(near.start, len(near)))
        self.rates = self._rate(near)  # spikes a frame of every pixel
        self.white = alpha or white_rate(recording.correct(self.rates))
        share = self.rates.mean().item()
        self.hint = ""
        if 0 < window * share < _FEW and window < end - begin:
            longer = min(2 * math.ceil(_ENOUGH / (2 * share)) + 1, end - begin)
            self.hint = (
                f"{share:.1%} of the bits are set, {window * share:.1f} spikes of a pixel in {window} frames: "
                f"--window {longer} shows less noise, and more blur where something moves"
            )

    def _plane(self, n: int) -> np.ndarray:
        return self.recording.unpack(self._planes[n - self.near.start])

    def _rate(self, frames: range) -> Tensor:
        total = sum(map(self._plane, frames), start=np.float32(0))
        return torch.from_numpy(total / np.float32(len(frames)))

    def picture(self, raw: Tensor) -> Tensor:
        """Return raw light as it is shown, (3, H, W) or (H, W)."""
        light, pattern = self.recording.correct(raw) / self.white, self.recording.bayer
        colour = demosaic(light, pattern) if pattern and min(light.shape) >= 3 else light
        return self.recording.show(colour, known=self.alpha is not None)

    def tfp(self) -> Tensor:
        """The picture of the middle by TFP."""
        return self.picture(self._rate(self.averaged))

    def tfi(self) -> Tensor:
        """The picture of the middle by TFI."""
        return self.picture(torch.from_numpy(search(self._plane, self.frame, self.near)).float().reciprocal())

    def raster(self) -> Tensor:
        """The spikes of one row of pixels, (W, T)."""
        spikes = np.stack([self._plane(n)[self.row].copy() for n in self.near])  # a view would hold its frame
        return torch.from_numpy(spikes).T

    def motion(self) -> tuple[Tensor, float, float] | None:
        """Motion from a window before the middle to one after it: colours, longest displacement, time between."""
        # so many frames that a cell of four pixels has a dozen spikes, or what moves is noise
        enough = math.ceil(3 / max(self.rates.mean().item(), 1e-6))
        length = min(max(_WINDOW // 2, enough), len(self.near) // 2)
        height, width = (side // 2 * 2 for side in self.recording.size)
        if length < 2 or min(height, width) < 32:
            return None
        from skimage.filters import gaussian
        from skimage.registration import optical_flow_ilk

        # whole cells of the mosaic, so that colours do not matter, and less noise
        frame = self.frame
        rates = (self._rate(range(frame - length, frame)), self._rate(range(frame, frame + length)))
        cells = [
            gaussian(F.avg_pool2d(self.recording.correct(rate)[None, :height, :width], 2)[0].numpy() / self.white, 1.5)
            for rate in rates
        ]
        y, x = optical_flow_ilk(*cells, radius=9, prefilter=True)
        flow = upsample_flow(torch.from_numpy(np.stack([x, y])).float()[None], 2)[0]
        longest = max(1.0, float(np.quantile(flow.norm(dim=0).numpy(), 0.99)))
        return flow_to_rgb(flow, longest), longest, length

    def sheet(self) -> bytes:
        """Everything about the middle, as the bytes of a PNG file."""
        from matplotlib.figure import Figure

        figure = Figure((16, 9), layout="constrained")
        axes = figure.subplots(2, 3)
        spikes = torch.from_numpy(self._plane(self.frame)).float()
        pictures = [
            (f"TFP, frames {self.averaged.start} .. {self.averaged.stop - 1}", self.tfp()),
            (f"TFI, frame {self.frame}", self.tfi()),
            (f"spikes of frame {self.frame}", 1 - spikes),
        ]
        if moves := self.motion():
            colours, longest, frames = moves
            pictures.append((f"motion in {frames} frames, red to the right, full colour {longest:.1f} pixels", colours))
        for place, (title, picture) in zip(axes.flat, pictures, strict=False):
            place.imshow((picture.movedim(0, -1) if picture.ndim == 3 else picture).numpy(), "gray", vmin=0, vmax=1)
            place.set_title(title)
        axes[1, 0].set_visible(bool(moves))
        begin, end = self.near.start - 0.5, self.near.stop - 0.5
        sides = begin, end, self.recording.size[1] - 0.5, -0.5
        axes[1, 1].imshow(1 - self.raster().numpy(), "gray", vmin=0, vmax=1, extent=sides, aspect="auto")
        axes[1, 1].set(title=f"spikes of row {self.row}", xlabel="frame", ylabel="column")
        silent = (self.rates == 0).float().mean()
        axes[1, 2].hist(self.rates.flatten().numpy(), bins=min(len(self.near), 80))
        axes[1, 2].set(
            title=f"mean {self.rates.mean():.3f}, {silent:.1%} of the pixels silent",
            xlabel="spikes a frame",
            ylabel="pixels",
        )
        file = io.BytesIO()
        figure.savefig(file, format="png")
        return file.getvalue()


def _span(text: str | None, recording: Recording) -> tuple[int, int]:
    """Return the first frame to show and the one after the last."""
    typed = re.fullmatch(r"(\d*):(\d*)", text or ":", re.ASCII)
    first, stop = (int(typed[1] or 0), int(typed[2] or recording.frames)) if typed else (0, 0)
    if not first < stop <= recording.frames:
        raise UsageError(
            f"--frames: expected A:B within 0:{recording.frames}, the frames of {recording.path}, got {text}"
        )
    return first, stop


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    recordings.add_arguments(parser)
    add = parser.add_argument
    output = ending_in(".png", said="a file that ends in .png")
    add("-o", "--output", required=True, type=output, metavar="OUT.png", help="the sheet to write")
    add(
        "--alpha", type=positive, metavar="A", help="gain of a simulated recording: a white pixel fires A times a frame"
    )
    add("--frames", metavar="A:B", help="which frames to show, from A to B - 1; all if not given")
    add("--window", type=whole(1), metavar="W", help=f"frames that tfp averages; {_WINDOW} if not given")
    add("--row", type=whole(0), metavar="Y", help="row of pixels whose spikes are drawn; the middle one if not given")

"""``spikekit view``: draw an overview of a recording."""

from __future__ import annotations

import argparse
import io
import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.arguments import ending_in, frames_of, positive, whole
from spikekit.cli import recordings
from spikekit.color.demosaic import demosaic
from spikekit.decoders.single_frame import search
from spikekit.flow.fields import upsample_flow
from spikekit.io.images import flow_to_rgb
from spikekit.io.sidecar import check_unclaimed
from spikekit.io.whole_file import write_whole
from spikekit.recording import Recording, white_rate
from spikekit.standard_output import say

#: Frames shown on each side of the middle one.
REACH = 200

_WINDOW = 41


def run(args: argparse.Namespace) -> None:
    """Draw an overview of one moment of a recording.

    It shows decoded pictures, spikes over time, a histogram of the spike rate, and motion. Only these frames are read.
    For pictures over time, see spikekit decode.

    Size, Bayer phase and brightness may be omitted if a side-car or --camera gives them.
    """
    shown = recordings.opened(args)
    chosen = frames_of("--frames", args.frames or ":", 0, shown.frames - 1)
    begin, end = chosen.start, chosen.stop
    check_unclaimed([args.output], args.file)
    moment = Moment(shown, begin, end, args.window or _WINDOW, args.alpha or shown.alpha)
    write_whole(args.output, moment.sheet())
    white = f"white: alpha {moment.alpha:g}" if moment.alpha else f"white: {moment.white:.3g} spikes per frame"
    say(f"{args.output}: frames {begin} .. {end - 1} of {shown.frames}, {white}{shown.said}")


class Moment:
    """Views around the middle of the frames ``begin`` .. ``end - 1`` of a recording.

    ``window`` is that of TFP in frames, ``alpha`` the light of a white pixel if known.
    """

    def __init__(self, recording: Recording, begin: int, end: int, window: int, alpha: float | None) -> None:
        self.recording, self.alpha, self.row = recording, alpha, recording.size[0] // 2
        self.frame = frame = (begin + end) // 2
        self.near = near = range(max(begin, frame - REACH), min(end, frame + REACH + 1))
        first = max(near.start, frame - min(window, end - begin) // 2)
        self.averaged = range(first, min(first + window, near.stop))
        self._planes = list(recording.packed(near.start, len(near)))
        self.rates = self._rate(near)  # (H, W), spikes per frame
        self.white = alpha or white_rate(recording.correct(self.rates), recording.bayer)

    def _plane(self, n: int) -> np.ndarray:
        return self.recording.unpack(self._planes[n - self.near.start])

    def _rate(self, frames: range) -> Tensor:
        total = sum(map(self._plane, frames), start=np.float32(0))
        return torch.from_numpy(total / np.float32(len(frames)))

    def picture(self, raw: Tensor) -> Tensor:
        """Return ``raw`` corrected, demosaiced and scaled for display, (3, H, W) or (H, W)."""
        light, pattern = self.recording.correct(raw) / self.white, self.recording.bayer
        colour = demosaic(light, pattern) if pattern and min(light.shape) >= 3 else light
        return self.recording.show(colour, known=self.alpha is not None)

    def tfp(self) -> Tensor:
        """Return the TFP picture of the middle frame."""
        return self.picture(self._rate(self.averaged))

    def tfi(self) -> Tensor:
        """Return the TFI picture of the middle frame."""
        return self.picture(torch.from_numpy(search(self._plane, self.frame, self.near)).float().reciprocal())

    def raster(self) -> Tensor:
        """Return the spikes of the middle row of pixels, (W, T)."""
        spikes = np.stack([self._plane(n)[self.row].copy() for n in self.near])  # a view would keep the whole frame
        return torch.from_numpy(spikes).T

    def motion(self) -> tuple[Tensor, float, float] | None:
        """Return colours, largest displacement and time of the motion from a window before the middle to one after."""
        # a cell of four pixels needs about a dozen spikes per window, else noise is taken for motion
        enough = math.ceil(3 / max(self.rates.mean().item(), 1e-6))
        length = min(max(_WINDOW // 2, enough), len(self.near) // 2)
        height, width = (side // 2 * 2 for side in self.recording.size)
        if length < 2 or min(height, width) < 32:
            return None
        from skimage.filters import gaussian
        from skimage.registration import optical_flow_ilk

        # average Bayer cells: no mosaic pattern, and less noise
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
        """Return all views as the bytes of a PNG file."""
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
            pictures.append((f"motion in {frames} frames, red = right, full colour = {longest:.1f} pixels", colours))
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
            xlabel="spikes per frame",
            ylabel="pixels",
        )
        file = io.BytesIO()
        figure.savefig(file, format="png")
        return file.getvalue()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    recordings.add_arguments(parser)
    add = parser.add_argument
    output = ending_in(".png", said="a file that ends in .png")
    add("-o", "--output", required=True, type=output, metavar="OUT.png", help="picture to write")
    add("--alpha", type=positive, metavar="A", help="spikes per frame of a white pixel; default: that of the side-car")
    add("--frames", metavar="A:B", help="frames A to B - 1 are shown; default: all")
    add("--window", type=whole(1), metavar="W", help=f"window of tfp in frames; default: {_WINDOW}")

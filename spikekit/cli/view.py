"""``spikekit view``: a recording as a sheet, an animation or an HTML page."""

from __future__ import annotations

import argparse
import base64
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from html import escape
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.arguments import UsageError, ending_in, positive, whole
from spikekit.cli import recordings
from spikekit.cli.drawing import fit, histogram, raster, sheet
from spikekit.color.demosaic import demosaic
from spikekit.decoders.single_frame import search
from spikekit.flow.fields import upsample_flow
from spikekit.io.failures import writing
from spikekit.io.image_bytes import gif_bytes, picture_bytes, png_bytes
from spikekit.io.images import flow_to_rgb
from spikekit.io.sidecar import check_unclaimed
from spikekit.io.whole_file import whole_file
from spikekit.progress import progress
from spikekit.recording import Recording, white_rate
from spikekit.standard_output import say

#: Frames on each side of the one in the middle that are looked at.
REACH = 200

#: Pictures of an animation or a page, at most.
MOST = 60

_SIDE = 480  # pixels of a picture, at most
_WINDOW = 41
_QUALITY = 85  # of the JPEGs of a page: a fifth of what PNG takes for pictures that are noisy by nature
_FEW, _ENOUGH = 4, 8  # spikes of a pixel in a window: below the one there is a hint at a window of the other


def run(args: argparse.Namespace) -> None:
    """Show a recording: decoded pictures, spikes over time, how often pixels fire, and what moves.

    A .png is a sheet about one moment, a .gif shows pictures sliding over time, a .html is a page with both
    and a slider, which works offline. Only the frames that are shown are read.

    Size, Bayer phase and brightness can be omitted if a side-car or --camera gives them.
    """
    shown = recordings.opened(args)
    begin, end = _span(args.frames, shown)
    window = min(args.window or _WINDOW, end - begin)
    ending = args.output.suffix.lower()
    if args.output.is_dir():
        raise ValueError(f"{args.output}: expected a file to write, got a folder")
    check_unclaimed([args.output], args.file)
    if args.row is not None and args.row >= shown.size[0]:
        raise UsageError(f"--row: expected 0 .. {shown.size[0] - 1}, got {args.row}")
    moment = Moment(shown, begin, end, window, args.alpha or shown.alpha, args.row)
    hint = "" if args.window else moment.hint
    if ending == ".png":
        data = png_bytes(sheet(moment.drawings()))
    else:
        if args.window is None:
            window = min(window, max(1, (end - begin) // 2))  # or nothing slides
        starts = [int(start) for start in np.linspace(begin, end - window, min(MOST, end - window - begin + 1))]
        pictures = progress(moment.sliding(starts, window), "pictures", len(starts))
        if ending == ".gif":
            data = gif_bytes(pictures, args.seconds / len(starts))
        else:
            data = _page(moment, starts, window, pictures, hint).encode()
    with writing(args.output), whole_file(args.output) as file:
        file.write(data)
    say(f"{args.output}: frames {begin} .. {end - 1} of {shown.frames}, {moment.said}")
    if hint:
        print(hint)


@dataclass(frozen=True)
class Moment:
    """A span of a recording, and what can be seen in it.

    Args:
        recording: the file.
        begin: first frame.
        end: the frame after the last.
        window: frames that TFP averages.
        alpha: light of a white pixel, where it is known.
        row: of the pixels whose spikes are drawn; the middle one when not given.
    """

    recording: Recording
    begin: int
    end: int
    window: int
    alpha: float | None
    row: int | None

    @property
    def frame(self) -> int:
        """The frame in the middle of those drawn."""
        return (self.begin + self.end) // 2

    @property
    def near(self) -> range:
        """The frames that are drawn: those around the one in the middle."""
        return range(max(self.begin, self.frame - REACH), min(self.end, self.frame + REACH + 1))

    @cached_property
    def _planes(self) -> list[np.ndarray]:
        return list(self.recording.packed(self.near.start, len(self.near)))

    def _plane(self, n: int) -> np.ndarray:
        return self.recording.unpack(self._planes[n - self.near.start])

    def _rate(self, first: int, last: int) -> Tensor:
        total = sum(map(self._plane, range(first, last)), start=np.float32(0))
        return torch.from_numpy(total / np.float32(last - first))

    @cached_property
    def rates(self) -> Tensor:
        """How often every pixel fires in the frames that are drawn, in spikes a frame."""
        return self._rate(self.near.start, self.near.stop)

    @property
    def white(self) -> float:
        """The value shown as white."""
        return self.alpha or white_rate(self.recording.correct(self.rates))

    @property
    def said(self) -> str:
        """The value shown as white, in words."""
        white = f"alpha {self.alpha:g} is white" if self.alpha else f"{self.white:.3g} spikes a frame are white"
        return white + self.recording.said

    @property
    def hint(self) -> str:
        """A longer window, where a pixel hardly fires in this one; nothing where there is enough to see."""
        share = self.rates.mean().item()
        if not 0 < self.window * share < _FEW or self.window == self.end - self.begin:
            return ""
        longer = min(2 * math.ceil(_ENOUGH / (2 * share)) + 1, self.end - self.begin)
        return (
            f"{share:.1%} of the bits are set, {self.window * share:.1f} spikes of a pixel in {self.window} frames: "
            f"--window {longer} shows less noise, and more blur where something moves"
        )

    def picture(self, raw: Tensor) -> Tensor:
        """Return raw light as it is shown, (3, H, W) or (H, W)."""
        light, pattern = self.recording.correct(raw) / self.white, self.recording.bayer
        colour = demosaic(light, pattern) if pattern and min(light.shape) >= 3 else light
        return fit(self.recording.show(colour, known=self.alpha is not None), _SIDE, _SIDE)

    def tfp(self) -> Tensor:
        """The picture of the middle by TFP."""
        first = max(self.near.start, self.frame - self.window // 2)
        return self.picture(self._rate(first, min(first + self.window, self.near.stop)))

    def tfi(self) -> Tensor:
        """The picture of the middle by TFI."""
        return self.picture(torch.from_numpy(search(self._plane, self.frame, self.near)).float().reciprocal())

    def sliding(self, starts: list[int], window: int) -> Iterator[Tensor]:
        """Pictures by TFP of the windows that begin at these frames."""
        for start in starts:
            yield self.picture(self.recording.counts(start, window) / window)

    def raster(self) -> Tensor:
        """The spikes of one row of pixels, time to the right."""
        spikes = np.stack([self._plane(n)[self.line].copy() for n in self.near])  # a view would hold its frame
        return raster(torch.from_numpy(spikes), _SIDE, _SIDE)

    @property
    def line(self) -> int:
        """The row of pixels whose spikes are drawn."""
        return self.recording.size[0] // 2 if self.row is None else self.row

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
        cells = [
            gaussian(F.avg_pool2d(self.recording.correct(rate)[None, :height, :width], 2)[0].numpy() / self.white, 1.5)
            for rate in (self._rate(self.frame - length, self.frame), self._rate(self.frame, self.frame + length))
        ]
        y, x = optical_flow_ilk(*cells, radius=9, prefilter=True)
        flow = upsample_flow(torch.from_numpy(np.stack([x, y])).float()[None], 2)[0]
        longest = max(1.0, float(np.quantile(flow.norm(dim=0).numpy(), 0.99)))
        return fit(flow_to_rgb(flow, longest), _SIDE, _SIDE), longest, length

    def drawings(self) -> list[list[tuple[str, Tensor]]]:
        """Everything about the middle, each with its title, in rows."""
        near, (height, width) = self.near, self.recording.size
        first = max(near.start, self.frame - self.window // 2)
        pictures = [
            (f"TFP, frames {first} .. {min(first + self.window, near.stop) - 1}", self.tfp()),
            (f"TFI, frame {self.frame}", self.tfi()),
        ]
        moves = self.motion()
        if moves:
            colours, longest, clocks = moves
            pictures.append((f"motion in {clocks} frames, red to the right, full colour {longest:.1f} pixels", colours))
        one = torch.from_numpy(self._plane(self.frame)).float()
        high, wide = pictures[0][1].shape[-2:]
        silent = (self.rates == 0).float().mean().item()
        return [
            pictures,
            [
                (f"spikes of row {self.line}, frames {near.start} .. {near.stop - 1} to the right", self.raster()),
                (f"spikes of frame {self.frame}, {height} x {width}", fit(1 - one, _SIDE, _SIDE)),
                (
                    f"spikes a frame: mean {self.rates.mean():.3f}, {silent:.1%} of the pixels silent",
                    histogram((self.rates * len(near)).round(), len(near), max(240, wide), max(160, high)),
                ),
            ],
        ]


_STYLE = (
    "body{font:15px system-ui,sans-serif;margin:2em auto;padding:0 max(1em,2vw);max-width:1500px;color:#222;"
    "background:#fff;overflow-wrap:anywhere}"
    "figure{display:inline-block;margin:0 1.5em 1.5em 0;max-width:100%;vertical-align:top}"
    "figcaption{margin-bottom:.4em}"
    "img{image-rendering:pixelated;max-width:100%;height:auto}img:not([hidden]){display:block}"
    "figure div+div{display:flex;gap:.6em;margin-top:.4em}input{flex:1;min-width:0}"
)


def _page(moment: Moment, starts: list[int], window: int, pictures: Iterable[Tensor], hint: str) -> str:
    def image(picture: Tensor, more: str = "", **how: Any) -> str:
        return f'<img {more}src="{_data(picture, **how)}" alt="">'

    name = escape(moment.recording.path.name)
    frames, (height, width) = moment.recording.frames, moment.recording.size
    figures = "".join(
        f"<figure><figcaption>{escape(title)}</figcaption>{image(picture)}</figure>"
        for row in moment.drawings()
        for title, picture in row
    )
    # encoded one by one, as they come: a page holds no more than one of them as numbers
    frames_of = "".join(image(picture, "hidden ", ending=".jpg", quality=_QUALITY) for picture in pictures)
    windows = moment.end - moment.begin - window + 1
    cut = f", {len(starts)} of {windows} windows" if len(starts) < windows else ""
    cut += f", shrunk to at most {_SIDE} pixels" if max(height, width) > _SIDE else ""
    last = len(starts) - 1
    return f"""<!DOCTYPE html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{name}</title><style>{_STYLE}</style>
<h1>{name}</h1>
<p>{frames} frames of {height} x {width}, {escape(moment.said)}{cut}</p>{f"<p>{hint}</p>" if hint else ""}
<figure><figcaption>TFP, frames <output id="at"></output></figcaption><div id="film">{frames_of}</div>
<div><button id="play" aria-label="play">&#9654;</button>
<input id="time" type="range" min="0" max="{last}" value="{last // 2}" aria-label="time"></div></figure>
{figures}
<script type="module">
const starts = {starts}, length = {window}, time = document.getElementById("time");
const play = document.getElementById("play");
let timer = 0;
function show() {{
  const n = +time.value;
  [...document.getElementById("film").children].forEach((picture, k) => picture.hidden = k !== n);
  document.getElementById("at").value = starts[n] + " .. " + (starts[n] + length - 1);
}}
function stop() {{
  clearInterval(timer);
  timer = 0;
  play.textContent = "\u25b6";
}}
function next() {{
  time.value = (+time.value + 1) % starts.length;
  show();
}}
play.onclick = () => {{
  if (timer) return stop();
  timer = setInterval(next, 100);
  play.textContent = "\u23f8";
}};
time.oninput = () => {{ stop(); show(); }};
show();
</script>
</html>
"""


def _data(picture: Tensor, ending: str = ".png", **how: Any) -> str:
    kind = {".png": "png", ".jpg": "jpeg"}[ending]
    return f"data:image/{kind};base64," + base64.b64encode(picture_bytes(picture, ending, **how)).decode()


def _span(text: str | None, recording: Recording) -> tuple[int, int]:
    """Return the first frame to show and the one after the last."""
    begin, end = ((text or ":") + ":").split(":")[:2]
    first, stop = int(begin or 0), int(end or recording.frames)
    if not first < stop <= recording.frames:
        raise UsageError(
            f"--frames: expected A:B within 0:{recording.frames}, as {recording.path} has {recording.frames} frames, "
            f"got {text}"
        )
    return first, stop


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    recordings.add_arguments(parser)
    add = parser.add_argument
    output = ending_in(".png", ".gif", ".html", said="a file that ends in .png, .gif or .html")
    add("-o", "--output", required=True, type=output, metavar="OUT", help="what to write: .png, .gif or .html")
    add(
        "--alpha", type=positive, metavar="A", help="gain of a simulated recording: a white pixel fires A times a frame"
    )
    add("--frames", type=_frames, metavar="A:B", help="which frames to show, from A to B - 1; all if not given")
    add("--window", type=whole(1), metavar="W", help=f"frames that tfp averages; {_WINDOW}, or half of what is shown")
    add("--row", type=whole(0), metavar="Y", help="row of pixels whose spikes are drawn; the middle one if not given")
    add("--seconds", type=positive, default=4.0, metavar="S", help="how long a .gif takes; 4")


def _frames(text: str) -> str:
    begin, colon, end = text.partition(":")
    if not colon or not all(part == "" or (part.isascii() and part.isdigit()) for part in (begin, end)):
        raise argparse.ArgumentTypeError(f"expected A:B, got {text}")
    return text

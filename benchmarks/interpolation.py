"""Quality of latent frames with known truth: ``python benchmarks/interpolation.py [FILM ...]``.

In films, a frame is left out and interpolated from its two neighbours. In scenes of exactly known motion, the frame
halfway between two frames is interpolated, for several displacements.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from spikekit.flow.interpolate import Between, Blend, FlowInterpolation, Still
from spikekit.io.video import read_video
from spikekit.metrics import psnr
from spikekit.scenes.analytic import Layer, Motion, Scene

METHODS: dict[str, Callable[[Tensor, Tensor], Between]] = {
    "nearest": Still(),
    "blend": Blend(),
    "flow": FlowInterpolation(),
    "flow, shrink 1": FlowInterpolation(shrink=1),
}

#: Displacements between the two frames, in pixels.
PIXELS = (0, 1, 2, 6, 15)

_Triple = tuple[Tensor, Tensor, Tensor]  # first, truth half way, second


def film(path: Path, every: int) -> Iterator[_Triple]:
    """Yield three consecutive frames, starting at every Nth frame."""
    frames = read_video(path)
    for n in range(0, len(frames) - 2, every):
        first, truth, second = frames[n : n + 3]
        yield first, truth, second


def scene(pixels: float, *, hidden: bool) -> _Triple:
    """Return a view of 256 x 256 that moves by a number of pixels, optionally with an object that moves against it."""
    from scipy.ndimage import gaussian_filter
    from skimage import data

    def picture(pixels: object) -> Tensor:  # slightly blurred, to avoid aliasing
        return torch.from_numpy(gaussian_filter(pixels / 255.0, (0.8, 0.8, 0))).permute(2, 0, 1).float()

    def motion(x: float, y: float) -> Motion:
        return Motion(velocity=(x * pixels / 20, y * pixels / 20))

    layers = [Layer(picture(data.astronaut()), motion(-0.4, 0.3) if hidden else motion(0.8, 0.6), (-100, -60))]
    if hidden:
        layers.append(Layer(picture(data.chelsea()[60:160, 120:220]), motion(0.6, 0), (80, 70), torch.ones(100, 100)))
    view = Scene(layers, 256, 256, frames=21)
    return view.rgb(0), view.rgb(10), view.rgb(20)


def measure(triples: Iterator[_Triple]) -> tuple[int, dict[str, float], dict[str, float]]:
    """Return the number of triples, and the mean PSNR and CPU seconds per pair of each method."""
    scores: dict[str, list[float]] = {name: [] for name in METHODS}
    seconds: dict[str, list[float]] = {name: [] for name in METHODS}
    for first, truth, second in triples:
        for name, method in METHODS.items():
            begin = time.process_time()
            made = method(first, second).at(0.5)
            seconds[name].append(time.process_time() - begin)
            scores[name].append(psnr(made, truth).item())
    count = len(scores["nearest"])
    return count, *({name: sum(given) / count for name, given in column.items()} for column in (scores, seconds))


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("films", nargs="*", type=Path, metavar="FILM", help="folder of pictures, or video file")
    parser.add_argument("--every", type=int, default=6, metavar="N", help="start at every Nth frame; default: 6")
    args = parser.parse_args(argv)
    cases = [(str(path.name), film(path, args.every)) for path in args.films]
    for hidden in (False, True):
        kind = "scene with an object in front" if hidden else "scene"
        cases += [(f"{kind}, {pixels} px", iter([scene(pixels, hidden=hidden)])) for pixels in PIXELS]

    def line(name: str, count: str, cells: Sequence[str]) -> None:
        sys.stdout.write(f"{name:36}{count:>6}" + "".join(f"{cell:>16}" for cell in cells) + "\n")
        sys.stdout.flush()

    line("PSNR in dB of the frame half way", "pairs", list(METHODS))
    for name, triples in cases:
        count, scores, seconds = measure(triples)
        line(name, str(count), [f"{score:.2f}" for score in scores.values()])
        if len(args.films) and triples is cases[0][1]:
            line("  CPU seconds a pair and frame", "", [f"{cost:.2f}" for cost in seconds.values()])


if __name__ == "__main__":
    main()

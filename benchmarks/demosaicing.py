"""Quality of demosaicing of known pictures: from their mosaics, and from TFI of simulated films.

``python benchmarks/demosaicing.py --pictures FOLDER --films FOLDER`` prints the table. ``--weights`` adds a column for
a colour network of scale 1, which reconstructs and demosaics in one step.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from lightning_modules.inference.predict import predict
from lightning_modules.networks import Network
from spikekit.color import demosaic, demosaic_residual, mosaic
from spikekit.decoders import tfi_at
from spikekit.flow import linear_motion
from spikekit.io import read_picture, read_video
from spikekit.metrics import psnr
from spikekit.scenes import FrameSequence
from spikekit.warp import demosaic_along_motion

FRAMES, TIMES, ENDS = 41, (10, 15, 20, 25, 30), (5, 35)
_PICTURES = {".bmp", ".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp"}
_SEED = 0


def picture_row(folder: Path) -> list[float]:
    """Return the mean PSNR of the pictures of a folder, demosaiced by ``demosaic`` and ``demosaic_residual``."""
    paths = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in _PICTURES]
    if not paths:
        raise ValueError(f"{folder}: holds no pictures")
    found = []
    for path in paths:
        rgb = read_picture(path)
        found.append([_decibels(fill(mosaic(rgb)), rgb) for fill in (demosaic, demosaic_residual)])
    return torch.tensor(found).mean(0).tolist()


def film_row(folder: Path, clocks: int, alpha: float, network: Network | None = None) -> list[float]:
    """Return the PSNR of the middle frame of a film, by TFI with all three demosaicings, and by a network.

    The sensor has the resolution of the film. Motion is the flow that interpolates the film's latent frames; the
    network estimates its own.

    Args:
        folder: folder of the film's frames.
        clocks: clocks from one frame to the next.
        alpha: light of a white pixel per clock, in thresholds.
        network: network of scale 1.
    """
    frames = read_video(folder)
    middle = len(frames) // 2
    around = -(-(FRAMES // 2) // clocks)
    if middle < around or middle + around >= len(frames):
        raise ValueError(f"{folder}: expected {2 * around + 1} frames or more, got {len(frames)}")
    film = FrameSequence(frames[middle - around : middle + around + 1], scale=1, alpha=alpha, clocks=clocks)
    clip = film.clip(around, FRAMES)
    spikes = torch.cat(list(film.spikes(clip.first, FRAMES, seed=_SEED)))
    raw = torch.stack([tfi_at(spikes, n) for n in TIMES]) / alpha
    flow = linear_motion(*(clip.flow(n) for n in ENDS), TIMES, first=ENDS[0], middle=FRAMES // 2, last=ENDS[1])
    alone, truth = raw[len(TIMES) // 2], clip.rgb(clip.middle)
    pictures = [demosaic(alone), demosaic_residual(alone), demosaic_along_motion(raw, flow)]
    if network is not None:
        pictures.append(predict(network, spikes[None], exposure=network.settings["alpha"] / alpha)[0])
    return [_decibels(rgb, truth) for rgb in pictures]


def _decibels(rgb: Tensor, truth: Tensor) -> float:
    return psnr(rgb.clamp(0, 1), truth).item()


def lines(
    pictures: Path | None, films: Path | None, clocks: int, alphas: Sequence[float], weights: str | None
) -> Iterator[str]:
    """Yield the lines of a Markdown table as they are measured."""
    names = ["demosaic", "demosaic_residual", "demosaic_along_motion"]
    network = None
    if weights is not None:
        network = Network.from_pretrained(weights)
        names.append(weights)
    yield f"| mosaic of | {' | '.join(names)} |"
    yield f"|{'---|' * (len(names) + 1)}"
    if pictures is not None:
        yield _line(pictures.name, [*picture_row(pictures), *[None] * (len(names) - 2)])
    for alpha in alphas if films is not None else ():
        rows, how = [], f"TFI, {clocks} clocks, alpha {alpha:g}"
        for folder in sorted(filter(Path.is_dir, films.iterdir())):
            rows.append(film_row(folder, clocks, alpha, network))
            yield _line(f"{folder.name}, {how}", rows[-1])
        yield _line(f"mean, {how}", torch.tensor(rows).mean(0).tolist())


def _line(name: str, decibels: Sequence[float | None]) -> str:
    return f"| {name} | {' | '.join('-' if value is None else f'{value:.2f}' for value in decibels)} |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="pictures, whose mosaics are demosaiced")
    parser.add_argument("--films", type=Path, metavar="FOLDER", help="folder with one folder of frames per film")
    parser.add_argument("--clocks", type=int, default=20, help="clocks from one frame to the next; default: 20")
    parser.add_argument(
        "--alpha", type=float, nargs="+", default=[0.4], help="light of a white pixel per clock; default: 0.4"
    )
    parser.add_argument("--weights", metavar="NAME", help="weights of a colour network of scale 1")
    asked = parser.parse_args(arguments)
    if asked.pictures is None and asked.films is None:
        parser.error("expected --pictures or --films")
    for line in lines(asked.pictures, asked.films, asked.clocks, asked.alpha, asked.weights):
        print(line, flush=True)


if __name__ == "__main__":
    main()

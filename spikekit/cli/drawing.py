"""Drawings of spikes: rasters, histograms and sheets with titles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.io.image_bytes import to_bytes
from spikekit.io.images import panel

_TITLE = 18  # rows above a picture that hold its title
_INK = 0.15


def fit(image: Tensor, width: int, height: int) -> Tensor:
    """Enlarge a picture by whole numbers, or shrink it by averaging, until it just fits.

    Args:
        image: (3, H, W) or (H, W), floating.
        width: largest.
        height: largest.

    Returns:
        The same number of dimensions.
    """
    times = min(width / image.shape[-1], height / image.shape[-2])
    if times >= 1:
        return image.repeat_interleave(int(times), -1).repeat_interleave(int(times), -2)
    size = [max(1, int(side * times)) for side in image.shape[-2:]]
    planes = image.reshape(1, -1, *image.shape[-2:])
    return F.interpolate(planes, size=size, mode="area").reshape(*image.shape[:-2], *size)


def raster(spikes: Tensor, width: int, height: int) -> Tensor:
    """Draw spikes as dark dots on white, time to the right.

    Args:
        spikes: (T, N), those of N pixels.
        width: of the drawing, at most.
        height: of the drawing, at most.

    Returns:
        (N', T'), every spike a rectangle of whole pixels, or shades where there are more than fit.
    """
    dots = _stretch(_stretch(spikes.T.float(), height).T, width).T
    return 1 - (1 - _INK) * dots


def _stretch(rows: Tensor, most: int) -> Tensor:
    """Repeat rows as often as fits, or average neighbours."""
    if len(rows) <= most:
        return rows.repeat_interleave(most // len(rows), 0)
    return F.adaptive_avg_pool1d(rows.T[None], most)[0].T


def histogram(counts: Tensor, frames: int, width: int, height: int) -> Tensor:
    """Draw how many pixels fire how often, from never to the most that any of them does.

    Args:
        counts: spikes of every pixel.
        frames: in which they were counted.
        width: of the drawing.
        height: of the drawing.

    Returns:
        (3, height, width), the rate in spikes a frame written below.
    """
    floor, levels = height - _TITLE, int(counts.max()) + 1
    merged = -(-levels // max(1, (width - 2) // 3))  # counts that share a bar
    bars = torch.bincount(counts.flatten().long() // merged)
    most = int(bars.max())
    image = torch.ones(3, height, width)
    for n, bar in enumerate(bars.tolist()):
        left, right = n * (width - 1) // len(bars), (n + 1) * (width - 1) // len(bars)
        top = floor - -(-bar * (floor - 4) // most)
        image[:, top:floor, left : max(left + 1, right - 1)] = torch.tensor([0.25, 0.45, 0.7])[:, None, None]
    image[:, floor] = _INK
    last = len(bars) * merged / frames
    for share, anchor in ((0.0, "la"), (0.25, "ma"), (0.5, "ma"), (0.75, "ma"), (1.0, "ra")):
        place = round(share * (width - 1))
        image[:, floor : floor + 4, place] = _INK
        image = write(image, f"{share * last:.2g}", (place, floor + 4), anchor)
    return image


def write(image: Tensor, text: str, place: tuple[int, int], anchor: str = "la") -> Tensor:
    """Write on a picture (3, H, W), at (x, y); the anchor is Pillow's."""
    from PIL import Image, ImageDraw, ImageFont

    sheet = Image.fromarray(to_bytes(image).numpy())
    ImageDraw.Draw(sheet).text(place, text, fill=(40, 40, 40), font=ImageFont.load_default(12), anchor=anchor)
    return torch.from_numpy(np.array(sheet)).permute(2, 0, 1) / 255


def sheet(rows: Sequence[Sequence[tuple[str, Tensor]]], gap: int = 12) -> Tensor:
    """Lay out pictures with their titles on white.

    Args:
        rows: (title, picture) of each.
        gap: white pixels between pictures and around all of them.

    Returns:
        One picture (3, H, W).
    """
    titled = []
    for row in rows:
        titled.append([])
        for title, image in row:
            above = torch.ones(3, image.shape[-2] + _TITLE, max(image.shape[-1], 7 * len(title)))
            above[:, _TITLE:, : image.shape[-1]] = image
            titled[-1].append(write(above, title, (0, 0)))
    return F.pad(panel(titled, gap), (gap, gap, gap, gap), value=1.0)

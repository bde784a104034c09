"""Cases of the benchmark: an operator, its alternatives, and its inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.timing import Run

SEED = 0


@dataclass(frozen=True)
class Size:
    """How large the inputs are: frames of a stream and of a clip, sensor, and the picture and channels of a warp."""

    frames: int
    clip: int
    height: int
    width: int
    side: int
    channels: int


SIZES = {
    "small": Size(frames=41, clip=11, height=32, width=48, side=32, channels=8),
    "full": Size(frames=400, clip=41, height=250, width=400, side=384, channels=64),
}


@dataclass(frozen=True)
class Other:
    """The alternative that a case is measured beside.

    Attributes:
        name: what it is called in the table.
        prepare: returns the run; imports what it needs, and may raise.
        pair: picks from our result and from the other one what should be equal; None where nothing should be.
        tolerance: largest difference that counts as equal.
        note: how it differs.
    """

    name: str
    prepare: Callable[[], Run]
    pair: Callable[[Any, Any], tuple[Tensor, Tensor]] | None = lambda ours, other: (ours, other)
    tolerance: float = 1e-4
    note: str = ""


@dataclass(frozen=True)
class Case:
    """One line of work for one operator.

    Attributes:
        name: what goes in and what comes out.
        run: our code.
        pixels: how many pixels of how many frames come out, for the throughput.
        read: bytes that must be read at least.
        written: bytes that must be written at least.
        others: what it is measured beside.
    """

    name: str
    run: Run
    pixels: int
    read: float
    written: float
    others: Sequence[Other] = ()


@dataclass(frozen=True)
class Setup:
    """Where the inputs of the cases come from."""

    size: Size
    device: torch.device
    folder: Path

    def rand(self, *shape: int) -> Tensor:
        """Return uniform numbers, the same ones for every call and device."""
        return torch.rand(shape, generator=torch.Generator().manual_seed(SEED)).to(self.device)

    def light(self, frames: int) -> Tensor:
        """Return light of a scene from dark to bright, that changes a little from clock to clock."""
        scene = torch.linspace(0.02, 0.9, self.size.width, device=self.device)
        return scene * (0.9 + 0.2 * self.rand(frames, self.size.height, self.size.width))

    def spikes(self, frames: int) -> Tensor:
        """Return the uint8 stream of that light."""
        charge = self.rand(self.size.height, self.size.width)
        spikes = []
        for light in self.light(frames):
            charge = charge + light
            spikes.append((charge >= 1).to(torch.uint8))
            charge = charge - spikes[-1]
        return torch.stack(spikes)

    def flow(self) -> Tensor:
        """Return smooth flow of a few pixels."""
        coarse = 8 * self.rand(1, 2, 5, 5) - 4
        return F.interpolate(coarse, size=(self.size.side, self.size.side), mode="bicubic", align_corners=True)


def sizes(value: Tensor) -> str:
    """Write the sizes of a tensor, as ``400x250x400``."""
    return "x".join(map(str, value.shape))


def floats(value: Tensor, read: float, written: float) -> tuple[float, float]:
    """Return the bytes of so many float32 copies of a tensor, read and written."""
    return 4 * read * value.numel(), 4 * written * value.numel()

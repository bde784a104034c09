"""Cases of the benchmark: an operator, its alternatives, and its inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
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
        prepare: returns the run, given the inputs of the case; imports what it needs, and may raise.
        pair: picks from our result and from the other one what should be equal; None where nothing should be.
        tolerance: largest difference that counts as equal.
        note: how it differs.
    """

    name: str
    prepare: Callable[..., Run]
    pair: Callable[[Any, Any], tuple[Tensor, Tensor]] | None = lambda ours, other: (ours, other)
    tolerance: float = 1e-4
    note: str = ""


def other(name: str, function: Callable[..., object], pair: Any = Other.pair, **how: Any) -> Other:
    """Return an alternative that is a plain function of the case's inputs and needs no preparation."""
    return Other(name, partial(partial, function), pair, **how)


@dataclass(frozen=True)
class Case:
    """One line of work for one operator.

    Attributes:
        name: what goes in and what comes out.
        function: our code.
        inputs: what it and the others are called with.
        others: what it is measured beside.
        channels: of a pixel that comes out, which count as one for the throughput.
        pixels: how many pixels of how many frames come out; those of the result when not given.
        read: bytes that must be read at least; those of the inputs when not given.
        written: bytes that must be written at least; those of the first result when not given.
    """

    name: str
    function: Callable[..., Any]
    inputs: tuple[Any, ...]
    others: Sequence[Other] = ()
    channels: int = 1
    pixels: int | None = None
    read: float | None = None
    written: float | None = None

    def run(self) -> Any:
        """Call our code."""
        return self.function(*self.inputs)

    def work(self, result: Any) -> tuple[int, float, float]:
        """Return the pixels, the bytes read and the bytes written, given the result."""
        first = result[0] if isinstance(result, tuple) else result
        read = sum(value.nbytes for value in self.inputs) if self.read is None else self.read
        written = first.nbytes if self.written is None else self.written
        return self.pixels or first.numel() // self.channels, read, written


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
        """Return the light of a scene from dark to bright that changes slightly from clock to clock."""
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

"""Firing rates of the pixels of a recording, from the first to the last spike of each."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class PixelRates:
    r"""Firing rate of every pixel.

    .. math:: r = \frac{n - 1}{t_n - t_1} \text{ for } n \ge 2 \text{ spikes, else } \frac{n}{T}

    Convention:
        In constant light, n - 1 whole thresholds lie between the first and the last of n spikes, and only these two are
        rounded to clocks. The error is about :math:`0.4 \, r / T`; that of n / T is 0.4 / T.

    Example:
        >>> spikes = torch.tensor([0, 1, 0, 0, 1, 0, 0, 1, 0, 0]).reshape(10, 1, 1)
        >>> PixelRates.of([spikes]).rate.item()
        0.333...
    """

    frames: int  # T
    count: Tensor  # n, (H, W), int64
    first: Tensor  # frame of the first spike; T if there is none
    last: Tensor  # frame of the last spike; -1 if there is none

    @classmethod
    def of(cls, chunks: Iterable[Tensor]) -> PixelRates:
        """Return the rates of a recording given as chunks (T_i, H, W)."""
        whole = None
        for spikes in chunks:
            fired, frames = spikes != 0, len(spikes)
            silent = ~fired.any(0)
            part = cls(
                frames,
                fired.sum(0),
                fired.byte().argmax(0).masked_fill(silent, frames),
                (frames - 1 - fired.flip(0).byte().argmax(0)).masked_fill(silent, -1),
            )
            whole = part if whole is None else whole + part
        return whole

    def __add__(self, later: PixelRates) -> PixelRates:
        """Return the rates of two consecutive recordings together."""
        return PixelRates(
            self.frames + later.frames,
            self.count + later.count,
            torch.where(self.count > 0, self.first, later.first + self.frames),
            torch.where(later.count > 0, later.last + self.frames, self.last),
        )

    @property
    def rate(self) -> Tensor:
        """Spikes per clock, (H, W), float64."""
        span = (self.last - self.first).clamp(min=1)
        return torch.where(self.count >= 2, (self.count - 1).double() / span, self.count.double() / self.frames)

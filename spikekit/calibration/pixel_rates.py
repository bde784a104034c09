"""How often every pixel of a recording fires, from its first to its last spike."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class PixelRates:
    r"""How often every pixel fires, counted frame by frame.

    .. math:: r = \frac{n - 1}{t_n - t_1} \text{ for } n \ge 2 \text{ spikes, else } \frac{n}{T}

    Convention:
        In light that does not change, n spikes are n - 1 whole thresholds, and only the two ends are rounded to clocks:
        the error is about :math:`0.4 \, r / T`, where that of n / T is 0.4 / T.

    Example:
        >>> spikes = torch.tensor([0, 1, 0, 0, 1, 0, 0, 1, 0, 0]).reshape(10, 1, 1)
        >>> PixelRates.of([spikes]).rate.item()
        0.333...
    """

    frames: int  # T
    count: Tensor  # n, (H, W), int64
    first: Tensor  # frame of the first spike; T where there is none
    last: Tensor  # of the last one; -1 where there is none

    @classmethod
    def of(cls, chunks: Iterable[Tensor]) -> PixelRates:
        """Count chunks (T_i, H, W) of one recording."""
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
        """Return the rates of a recording and of what follows it without a gap."""
        return PixelRates(
            self.frames + later.frames,
            self.count + later.count,
            torch.where(self.count > 0, self.first, later.first + self.frames),
            torch.where(later.count > 0, later.last + self.frames, self.last),
        )

    @property
    def rate(self) -> Tensor:
        """Spikes a clock, (H, W), float64."""
        span = (self.last - self.first).clamp(min=1)
        return torch.where(self.count >= 2, (self.count - 1).double() / span, self.count.double() / self.frames)

"""Calibration of a sensor: gain, dark rate and defects of every pixel, and the correction."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from spikekit.check import check_planes
from spikekit.color.cfa import GREY, bayer_mask
from spikekit.sensor.noise import HOT, WORKS

_NEIGHBORS = 4
_LEAST_GAIN = 1e-4  # keeps light finite, even in half precision


@dataclass(frozen=True, eq=False)
class Calibration:
    r"""Response of a sensor's pixels to light.

    .. math:: r = g I + d, \qquad \hat I = \max(0, (r - d) / g)

    Convention:
        r is the rate of a pixel in spikes per clock in light I, g its gain and d its dark rate, for a threshold of 1;
        this is the mean of :class:`SensorNoise`. Gains are relative: their mean over the pixels of a colour is 1. The
        light of a dead or hot pixel is the mean of the four nearest working pixels of its colour, weighted by inverse
        distance.

    Args:
        gain: g, (H, W), 1e-4 to 1e4.
        dark: d, (H, W), in spikes per clock, 0 to 1.
        defects: (H, W), uint8: 0 for a working pixel, 1 for a dead one, 2 for a hot one.

    Raises:
        ValueError: the planes differ in size, have a wrong type, or hold values out of range.

    Example:
        >>> gain = torch.tensor([[1.25, 0.75, 1.0]])
        >>> calibration = Calibration(gain, torch.zeros(1, 3), torch.tensor([[0, 0, 1]], dtype=torch.uint8))
        >>> calibration.correct(torch.tensor([[0.5, 0.3, 0.0]]))
        tensor([[0.4000, 0.4000, 0.4000]])

    Reference:
        Flat-field correction; Gao et al., The analysis and suppressing of non-uniformity in a high-speed spike-based
        image sensor, Sensors 18(12), 4232, 2018.
    """

    gain: Tensor
    dark: Tensor
    defects: Tensor
    _fills: dict[str | None, tuple[Tensor, Tensor, Tensor]] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        kinds = {"gain": torch.float32, "dark": torch.float32, "defects": torch.uint8}
        for name, kind in kinds.items():
            plane = getattr(self, name)
            check_planes(name, plane, 2, "(H, W)")
            if plane.shape != self.gain.shape or plane.ndim != 2 or plane.dtype != kind:
                got = f"{tuple(plane.shape)} of {plane.dtype}"
                raise ValueError(f"{name}: expected (H, W) of {kind}, all of one size, got {got}")
        for name, least, most in (("gain", _LEAST_GAIN, 1 / _LEAST_GAIN), ("dark", 0, 1), ("defects", WORKS, HOT)):
            plane = getattr(self, name)
            good = (plane >= least) & (plane <= most)
            if not good.all():
                raise ValueError(f"{name}: expected {least:g} to {most:g}, got {plane[~good][0].item():g}")

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the sensor."""
        return tuple(self.gain.shape)

    @property
    def ideal(self) -> Tensor:
        """Which pixels need no correction, (H, W)."""
        return (self.gain == 1) & (self.dark == 0) & (self.defects == WORKS)

    def flip(self) -> Calibration:
        """Return the calibration of the sensor upside down."""
        return Calibration(*(plane.flip(0) for plane in (self.gain, self.dark, self.defects)))

    def correct(self, raw: Tensor, pattern: str | None = None) -> Tensor:
        """Return the light of an ideal sensor.

        Args:
            raw: rates :math:`(*, H, W)`, in spikes per clock, as decoders return them.
            pattern: Bayer phase; ``None`` for a grey sensor.

        Raises:
            TypeError: ``raw`` is not a floating-point tensor.
            ValueError: ``raw`` has another size, or no pixel of a colour works.
        """
        check_planes("raw", raw, 2, "(*, H, W)", floating=True)
        if tuple(raw.shape[-2:]) != self.size:
            raise ValueError(f"raw: expected (*, {self.size[0]}, {self.size[1]}), got {tuple(raw.shape)}")
        light = ((raw - self.dark.to(raw)) / self.gain.to(raw)).clamp(min=0)
        if pattern not in self._fills:
            self._fills[pattern] = _nearest_that_work(self.defects.numpy() != WORKS, pattern)
        bad, near, weight = (part.to(raw.device) for part in self._fills[pattern])
        if len(bad):
            pixels = light.flatten(-2)
            pixels[..., bad] = (pixels[..., near] * weight.to(raw)).sum(-1)
        return light


def _nearest_that_work(bad: np.ndarray, pattern: str | None) -> tuple[Tensor, Tensor, Tensor]:
    """Return defective pixels, the nearest working pixels of their colour, and weights that add up to 1."""
    from scipy.spatial import cKDTree

    near, weight = np.zeros((bad.sum(), _NEIGHBORS), int), np.zeros((bad.sum(), _NEIGHBORS))
    for pixels in bayer_mask(*bad.shape, pattern or GREY, device="cpu", dtype=torch.bool).numpy():
        wrong, right = pixels & bad, pixels & ~bad
        if not wrong.any():
            continue
        if not right.any():
            raise ValueError("defects: expected working pixels of every colour, got none of one")
        count = min(_NEIGHBORS, right.sum())
        distance, index = cKDTree(np.argwhere(right)).query(np.argwhere(wrong), list(range(1, count + 1)))
        near[wrong[bad], :count], weight[wrong[bad], :count] = np.flatnonzero(right)[index], 1 / distance
    places, shares = np.flatnonzero(bad), weight / weight.sum(-1, keepdims=True)
    return torch.from_numpy(places), torch.from_numpy(near), torch.from_numpy(shares)

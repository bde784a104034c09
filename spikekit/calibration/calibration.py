"""Calibration of a sensor: gain, dark rate and defects of every pixel, the correction of light and spikes, its file."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spikekit.arguments import home_path, one_line
from spikekit.check import check_planes, check_size, default_float
from spikekit.color.cfa import GREY, bayer_mask
from spikekit.decoders.dense import tfi
from spikekit.io.failures import no_pipe
from spikekit.io.images import MOST_PIXELS
from spikekit.io.whole_file import write_whole
from spikekit.sensor.integrate_fire import spike_integrate_fire
from spikekit.sensor.noise import HOT, WORKS

#: Ending of a recording's own calibration file.
ENDING = ".calibration.safetensors"

_KIND = "spikekit calibration 1"
_PLANES = {"gain": "F32", "dark": "F32", "defects": "U8"}

_NEIGHBORS = 4
_LEAST_GAIN = 1e-4  # keeps light finite, even in half precision
_GOLDEN = (math.sqrt(5) - 1) / 2
_ROUNDING = 1e-4  # tolerance for rounding errors in sums of light, in thresholds


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
        check_size("raw", raw.shape[-2:], self.size, " as the calibration")
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


def correct_spikes(spikes: Tensor, calibration: Calibration | None, pattern: str | None = None) -> Tensor:
    r"""Return the spikes that an ideal sensor would have fired, for networks, which take spikes rather than light.

    .. math:: \hat I_n = \text{corrected } 1 / \Psi_n, \quad \hat S = \text{spikes of } \hat I

    Convention:
        The light at every clock is that of :func:`spikekit.tfi`, which integrates to one threshold between two spikes.
        It is corrected by :meth:`Calibration.correct` and fed to :func:`spikekit.spike_integrate_fire`. The initial
        charge reproduces the first spike of each pixel. A pixel that needs no correction keeps its spikes, bit for bit;
        a dead or hot one fires according to the mean light of its neighbours. Only pixels that keep their spikes pass
        their gradient.

    Args:
        spikes: zeros and ones, :math:`(*, T, H, W)`.
        calibration: the calibration of the sensor; ``None`` for an ideal one, whose spikes are returned.
        pattern: Bayer phase; ``None`` for a grey sensor.

    Returns:
        Zeros and ones of the same shape and dtype.

    Raises:
        TypeError: ``spikes`` is not a tensor of real numbers.
        ValueError: ``spikes`` has fewer than three dimensions, or not the size of the calibration.

    Example:
        >>> spikes = torch.tensor([0, 1, 0, 0, 1, 0, 0, 1, 0, 0]).reshape(10, 1, 1)
        >>> sensor = Calibration(torch.full((1, 1), 0.5), torch.zeros(1, 1), torch.zeros(1, 1, dtype=torch.uint8))
        >>> correct_spikes(spikes, sensor).flatten().tolist()
        [1, 1, 0, 1, 1, 0, 1, 1, 0, 1]
    """
    check_planes("spikes", spikes, 3, "(*, T, H, W)")
    if calibration is None:
        return spikes
    check_size("spikes", spikes.shape[-2:], calibration.size, " as the calibration")
    fired = spikes != 0
    light = calibration.correct(tfi(fired, dtype=torch.promote_types(default_float(spikes), torch.float32)), pattern)
    first = fired.byte().argmax(-3, keepdim=True)
    until = light.cumsum(-3).gather(-3, first).squeeze(-3)
    charge = (1 - until + _ROUNDING) % 1
    place = torch.arange(charge.shape[-2] * charge.shape[-1], device=spikes.device).reshape(charge.shape[-2:])
    filled = (calibration.defects != 0).to(spikes.device)
    charge = torch.where(filled, place * _GOLDEN % 1, charge)
    again, _ = spike_integrate_fire(light, charge=charge, dtype=torch.uint8)
    return torch.where(calibration.ideal.to(spikes.device), spikes, again.to(spikes.dtype))


def write_calibration(path: str | Path, calibration: Calibration) -> None:
    """Write a calibration atomically.

    Args:
        path: the file to write; its name ends in .safetensors.
        calibration: the calibration. The commands store its rows in the order of the recording, before any flip.

    Raises:
        ValueError: the name has another ending.
        OSError: the file cannot be written.

    Example:
        >>> import tempfile, torch
        >>> planes = torch.ones(4, 6), torch.zeros(4, 6), torch.zeros(4, 6, dtype=torch.uint8)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_calibration(f"{folder}/street.calibration.safetensors", Calibration(*planes))
        ...     read_calibration(f"{folder}/street.calibration.safetensors").size
        (4, 6)
    """
    if Path(path).suffix != ".safetensors":
        raise ValueError(f"{path}: expected a name that ends in .safetensors")
    from safetensors.torch import save

    planes = {name: getattr(calibration, name).contiguous() for name in _PLANES}
    write_whole(path, save(planes, {"kind": _KIND}))


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration. The file cannot run code.

    Args:
        path: a file written by :func:`write_calibration` or ``spikekit calibrate``.

    Returns:
        The calibration, with rows in the order of the file.

    Raises:
        ValueError: the file cannot be read, is damaged, or is not a valid calibration; the message is one line and
            names the file.

    Example:
        >>> read_calibration("street.calibration.safetensors")
        Traceback (most recent call last):
        ValueError: street.calibration.safetensors: not a readable calibration (No such file or directory...
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(no_pipe(home_path(path)), "pt") as file:
            kind = (file.metadata() or {}).get("kind")
            if kind != _KIND:
                raise ValueError(f"expected {_KIND}, got {str(kind)[:80]}")
            parts = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118
            stored = {name: (part.get_dtype(), tuple(part.get_shape())) for name, part in parts.items()}
            size = stored.get("gain", (None, ()))[1]
            if stored != {name: (dtype, size) for name, dtype in _PLANES.items()}:
                raise ValueError(f"expected gain, dark and defects of one size, got {str(stored)[:200]}")
            if len(size) != 2 or not 0 < size[0] * size[1] <= MOST_PIXELS:
                raise ValueError(f"expected (H, W) of at most {MOST_PIXELS} pixels, got {size}")
            return Calibration(**{name: file.get_tensor(name) for name in _PLANES})
    except (SafetensorError, OSError, ValueError) as error:
        raise ValueError(f"{path}: not a readable calibration ({one_line(error)[:300]})") from error

"""Camera presets: file layout, Bayer phase and display of known cameras, read from JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from functools import cache
from importlib.resources import files
from pathlib import Path

import torch
from torch import Tensor

from spikekit.arguments import home_path, one_line
from spikekit.check import check_planes, check_positive, check_whole
from spikekit.color.cfa import bayer_pattern
from spikekit.io.failures import no_pipe

_PRESETS = files("spikekit.io") / "camera_presets"

#: Names of the presets of :func:`camera`.
CAMERAS = tuple(sorted(preset.name[: -len(".json")] for preset in _PRESETS.iterdir() if preset.name.endswith(".json")))


@dataclass(frozen=True)
class Camera:
    """File layout, Bayer phase and display of a type of spike camera.

    Convention:
        :meth:`prepare` drops the columns that are not pixels, flips frames that are stored upside down, and crops the
        border, in this order. ``pattern`` is the Bayer phase after the flip, ``prepared_pattern`` that after the crop.

    Args:
        name: short name.
        title: description.
        height: rows of a frame.
        width: columns of a frame, without dropped ones.
        drop: stored columns that are not pixels, as pairs (first, last + 1) in increasing order.
        rate: clocks per second.
        flip: frames are stored upside down.
        pattern: Bayer phase of upright frames; ``None`` for a grey camera.
        crop: rows and columns to cut off: (top, bottom, left, right).
        gain: factor that pictures are multiplied by for display.
        gamma: gamma of the display encoding.
        source: origin of these values.

    Raises:
        TypeError: a value has the wrong type.
        ValueError: a value is out of range; the message names it.
    """

    name: str
    title: str
    height: int
    width: int
    drop: tuple[tuple[int, int], ...]
    rate: float
    flip: bool
    pattern: str | None
    crop: tuple[int, int, int, int]
    gain: float
    gamma: float
    source: str

    def __post_init__(self) -> None:
        for name, kind in {"name": str, "title": str, "source": str, "flip": bool}.items():
            if not isinstance(getattr(self, name), kind):
                raise TypeError(f"{name}: expected {kind.__name__}, got {repr(getattr(self, name))[:80]}")
        for name in ("rate", "gain", "gamma"):
            check_positive(name, getattr(self, name))
        for name in ("height", "width"):
            check_whole(name, getattr(self, name))
        if self.pattern is not None:
            bayer_pattern(self.pattern)
        good = isinstance(self.drop, tuple) and all(_are_places(part, 2) for part in self.drop)
        if not good or list(self._edges) != sorted(self._edges):
            raise ValueError(f"drop: expected pairs [first, last + 1] of columns, in order, got {self.drop}")
        if not _are_places(self.crop, 4) or min(self.prepared_size) < 1:
            raise ValueError(f"crop: expected [top, bottom, left, right] that leaves pixels, got {self.crop}")

    @property
    def stored_width(self) -> int:
        """Columns of a raw stream, including those that are not pixels."""
        return self.width + sum(stop - start for start, stop in self.drop)

    @property
    def _edges(self) -> tuple[int, ...]:
        """Starts and ends, in turn, of the stored columns that are pixels."""
        return (0, *(edge for part in self.drop for edge in part), self.stored_width)

    @property
    def prepared_size(self) -> tuple[int, int]:
        """(H, W) of the frames that :meth:`prepare` returns."""
        top, bottom, left, right = self.crop
        return self.height - top - bottom, self.width - left - right

    @property
    def prepared_pattern(self) -> str | None:
        """Bayer phase of the frames that :meth:`prepare` returns; ``None`` for a grey camera."""
        if self.pattern is None:
            return None
        pattern = bayer_pattern(self.pattern)
        top, _, left, _ = self.crop
        return "".join(pattern[2 * ((top + y) % 2) + (left + x) % 2] for y in (0, 1) for x in (0, 1))

    def prepare(self, spikes: Tensor, *, flip: bool | None = None) -> Tensor:
        """Convert stored frames to upright frames without border and without columns that are not pixels.

        Args:
            spikes: stored frames :math:`(*, H, W)`, with or without the columns that are not pixels.
            flip: flip the rows; default: the camera's ``flip``. Use ``False`` for frames that are upright already.

        Returns:
            Frames :math:`(*, H', W')` of :attr:`prepared_size`, in the dtype of ``spikes``.

        Raises:
            TypeError: ``spikes`` is not a tensor of real numbers.
            ValueError: the frames have another size.
        """
        check_planes("spikes", spikes, 2, "(*, H, W)")
        height, width = spikes.shape[-2:]
        if height != self.height or width not in (self.width, self.stored_width):
            widths = " or ".join(str(w) for w in dict.fromkeys((self.width, self.stored_width)))
            expected = f"{self.height} x {widths} for the camera {self.name}"
            raise ValueError(f"spikes: expected {expected}, got {height} x {width}")
        if width != self.width:
            kept = [spikes[..., a:b] for a, b in zip(self._edges[::2], self._edges[1::2], strict=True)]
            spikes = torch.cat(kept, dim=-1)
        if self.flip if flip is None else flip:
            spikes = spikes.flip(-2)
        top, bottom, left, right = self.crop
        return spikes[..., top : self.height - bottom, left : self.width - right]

    def display(self, picture: Tensor) -> Tensor:
        r"""Apply the gain and gamma of the camera to a picture.

        .. math:: \operatorname{clip}(\text{gain} \cdot I, 0, 1)^{1 / \text{gamma}}

        Args:
            picture: light from a decoder or network, floating, any shape; white is 1.

        Returns:
            The picture for display, of the same shape, in [0, 1].

        Raises:
            TypeError: ``picture`` is not a floating-point tensor.
        """
        check_planes("picture", picture, 2, "(*, H, W)", floating=True)
        return (picture * self.gain).clamp(0, 1) ** (1 / self.gamma)


def camera(name: str | Path) -> Camera:
    """Load one of :data:`CAMERAS` by name, or a camera from a JSON file of the same form.

    Args:
        name: name of a preset, or a path that ends in ``.json``.

    Returns:
        The camera.

    Raises:
        ValueError: the name is unknown, or the file cannot be read or does not describe a camera.

    Example:
        >>> CAMERAS
        ('m1k40', 'm1k40-bayer', 'uhsr', 'vidar')
        >>> colour = camera("m1k40-bayer")
        >>> colour.prepare(torch.zeros(2, 1000, 1024, dtype=torch.uint8)).shape, colour.prepared_pattern
        (torch.Size([2, 992, 992]), 'RGGB')
    """
    own = str(name).endswith(".json")
    if not own and name not in CAMERAS:
        raise ValueError(f"camera: expected {', '.join(CAMERAS)}, or a .json file, got {name}")
    file = home_path(name) if own else _PRESETS / f"{name}.json"
    wanted = [field.name for field in fields(Camera) if field.name != "name"]
    try:
        data = json.loads((no_pipe(file) if own else file).read_text(encoding="utf-8"))
        if not isinstance(data, dict) or set(data) != set(wanted):
            got = ", ".join(data) if isinstance(data, dict) else type(data).__name__
            raise ValueError(f"expected an object with {', '.join(wanted)}, got {got[:300]}")
        return Camera(**{"name": file.name.removesuffix(".json")} | {key: _frozen(data[key]) for key in wanted})
    except (OSError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{name}: {one_line(error)[:500]}") from error


@cache
def usual_sizes() -> dict[tuple[int, int], list[Camera]]:
    """Return the cameras of :data:`CAMERAS` by the (height, width) of their stored frames."""
    sizes: dict[tuple[int, int], list[Camera]] = {}
    for known in map(camera, CAMERAS):
        for width in dict.fromkeys((known.width, known.stored_width)):
            sizes.setdefault((known.height, width), []).append(known)
    return dict(sorted(sizes.items()))


def _frozen(value: object) -> object:
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def _are_places(values: object, count: int) -> bool:
    """Return whether ``values`` is a tuple of ``count`` whole numbers >= 0."""
    return (
        isinstance(values, tuple)
        and len(values) == count
        and all(isinstance(value, int) and not isinstance(value, bool) and value >= 0 for value in values)
    )

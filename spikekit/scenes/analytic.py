"""Analytic scenes: moving pictures whose light, ground truth and flow are exact at every clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike
from torch import Tensor

from spikekit.check import check_planes, check_positive, check_whole
from spikekit.color.cfa import Pattern, bin_to_sensor, cfa_sites

_CHUNK = 1 << 16  # positions sampled at a time on a CPU, to fit in the cache
_CHUNK_ELSEWHERE = 1 << 26  # on a GPU, to save launches


@dataclass(frozen=True)
class Motion:
    r"""Motion of a layer: accelerated translation, and constant rotation and zoom about a centre.

    .. math:: x(\tau) = c + z^\tau R(\omega \tau) (x - c) + v \tau + \tfrac12 a \tau^2

    Convention:
        :math:`\tau` is the clock, counted from the middle of the clip, where the motion is the identity. Positions are
        (x, y), x right, y down, pixel centres at whole numbers. A positive rotation turns x towards y, clockwise on the
        screen. For a batch of scenes, every argument may be an array (B, 2) or (B,).

    Args:
        velocity: v, (x, y) in pixels per clock.
        rotation: :math:`\omega`, radians per clock.
        zoom: z, magnification per clock, above 0.
        center: c, (x, y).
        acceleration: a, (x, y) in pixels per clock squared.

    Raises:
        ValueError: ``zoom`` is not above 0.

    Example:
        >>> Motion(velocity=(0.25, 0.0), rotation=0.01, center=(16.0, 16.0)).zoom
        1.0
    """

    velocity: ArrayLike = (0.0, 0.0)
    rotation: ArrayLike = 0.0
    zoom: ArrayLike = 1.0
    center: ArrayLike = (0.0, 0.0)
    acceleration: ArrayLike = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not (np.asarray(self.zoom) > 0).all():
            raise ValueError(f"zoom: expected numbers above 0, got {np.min(self.zoom)}")

    def _turn_and_shift(self, tau: Tensor) -> tuple[Tensor, Tensor]:
        """Return the motion ``turn * position + shift`` of complex positions x + iy; both (B, T)."""
        center, velocity, acceleration = map(_points, (self.center, self.velocity, self.acceleration))
        growth, rotation = (torch.from_numpy(np.atleast_1d(n)) for n in (np.log(self.zoom), np.float64(self.rotation)))
        turn = torch.exp(tau * torch.complex(growth, rotation)[:, None])
        return turn, center + (velocity + acceleration / 2 * tau) * tau - center * turn


def _points(pairs: ArrayLike) -> Tensor:
    """Return pairs (x, y) as complex numbers x + iy, (B, 1)."""
    return torch.view_as_complex(torch.from_numpy(np.array(pairs, "float64").reshape(-1, 1, 2)))


@dataclass(frozen=True, eq=False)
class Layer:
    """A moving picture: the background of a scene, or an object in front of it.

    Args:
        picture: ``rgb`` (3, h, w), float32 or float64; (1, h, w) for grey sensors only; (B, 3, h, w) or (B, 1, h, w)
            for a batch of scenes.
        motion: motion of the picture.
        position: (x, y) of the picture's pixel (0, 0) in the view, at the middle of the clip; (B, 2) for a batch.
        mask: opacity of an object, 0 to 1, (h, w), or (B, h, w) for a batch; 0 outside its border. ``None`` for a
            background, which is mirrored at its border.

    Raises:
        TypeError: ``picture`` is not float32 or float64.
        ValueError: the sizes do not match.

    Example:
        >>> coin = Layer(torch.rand(3, 9, 9), Motion(velocity=(1.0, 0.0)), position=(4, 4), mask=torch.ones(9, 9))
    """

    picture: Tensor
    motion: Motion = Motion()
    position: ArrayLike = (0, 0)
    mask: Tensor | None = None

    def __post_init__(self) -> None:
        check_planes("picture", self.picture, 3, "(3, h, w)", floating=True)
        if self.picture.ndim > 4 or self.picture.shape[-3] not in (1, 3):
            got = tuple(self.picture.shape)
            raise ValueError(f"picture: expected (3, h, w), (1, h, w), or a batch of them, got {got}")
        if self.picture.dtype not in (torch.float32, torch.float64):
            raise TypeError(f"picture: expected float32 or float64, got {self.picture.dtype}")
        size = tuple(self.picture.shape[:-3] + self.picture.shape[-2:])
        if self.mask is not None and getattr(self.mask, "shape", None) != size:
            got = tuple(self.mask.shape) if isinstance(self.mask, Tensor) else type(self.mask).__name__
            raise ValueError(f"mask: expected {size}, got {got}")

    def _planes(self) -> tuple[Tensor, Tensor]:
        """Return the planes to sample, (B, C, h, w), and the positions of their corners, (B, 1).

        Objects are padded, with the mask as last plane.
        """
        picture, corner = self.picture.reshape(-1, *self.picture.shape[-3:]), _points(self.position)
        if self.mask is None:
            return picture, corner
        mask = F.pad(self.mask.to(picture).reshape(-1, 1, *picture.shape[-2:]), (1, 1, 1, 1))
        return torch.cat([F.pad(picture, (1, 1, 1, 1), "replicate"), mask], dim=1), corner - (1 + 1j)


def _inside(position: Tensor, length: int, padding: str) -> Tensor:
    """Map whole positions on an axis into the picture, like the padding of grid_sample."""
    index = position.long()
    if padding == "border":
        return index.clamp(0, length - 1)
    index = index.remainder(2 * length)
    return torch.minimum(index, 2 * length - 1 - index)


def _sample(
    planes: Tensor, corner: Tensor, turn: Tensor, shift: Tensor, rows: Tensor, columns: Tensor, padding: str
) -> Tensor:
    """Sample moved planes (B, C, h, w) at ``rows`` x ``columns`` of the view: (B, C, T, rows, columns).

    All arguments but the planes are on the CPU, to avoid synchronisation.
    """
    scenes, _, height, width = planes.shape
    frames, device = turn.shape[1], planes.device
    whole = turn[0, 0] == 1 and all((axis == axis.round()).all() for axis in (rows, columns))
    if whole and (turn == 1).all() and (shift == 0).all():
        # copy pixels at rest, so that the ground truth equals the picture bit for bit
        i = _inside(rows - corner.imag, height, padding).to(device).expand(scenes, -1)
        j = _inside(columns - corner.real, width, padding).to(device).expand(scenes, -1)
        which = torch.arange(scenes, device=device)[:, None, None]
        seen = planes.movedim(1, -1)[which, i[:, :, None], j[:, None, :]].movedim(-1, 1)
        return seen[:, :, None].expand(-1, -1, frames, -1, -1).clone()
    to_centre = corner + complex(width - 1, height - 1) / 2
    turn, shift, to_centre, rows, columns = (part.to(device) for part in (turn, shift, to_centre, rows, columns))

    def normalized(position: Tensor) -> Tensor:
        kind = torch.complex64 if planes.dtype == torch.float32 else torch.complex128
        return torch.complex(position.real * (2 / width), position.imag * (2 / height)).to(kind)

    # The source position of a pixel is affine: a part from its column plus a part from its row.
    across = normalized(columns / turn[..., None])
    down = normalized((1j * rows - shift[..., None]) / turn[..., None] - to_centre[..., None])
    grid = torch.view_as_real(across[:, :, None, :] + down[:, :, :, None]).expand(scenes, -1, -1, -1, -1)
    if scenes == 1:  # one batch element per clock, for the threads of a CPU
        seen = F.grid_sample(planes.expand(frames, -1, -1, -1), grid[0], "bilinear", padding, align_corners=False)
        return seen.transpose(0, 1)[None]
    seen = F.grid_sample(planes, grid.flatten(1, 2), "bilinear", padding, align_corners=False)
    return seen.unflatten(2, (frames, -1))


class Scene:
    r"""A stack of moving pictures, seen by a spike camera.

    Convention:
        The view has high-resolution pixels, centres at whole numbers. The scene is the bilinear interpolant of its
        pictures and masks, evaluated exactly at every clock, without interpolation in time. At the middle, clock
        ``frames // 2``, every motion is the identity: the view shows the original pixels, which are the ground truth.
        Later objects cover earlier ones.

        A sensor pixel averages the s x s view pixels of its own colour, or their luminance if the sensor is grey, see
        :func:`spikekit.bin_to_sensor`. The sensor pixel (x, y) is centred at (s x + (s - 1) / 2, s y + (s - 1) / 2) of
        the view.

        Batched layers give a batch of scenes of one size, and results have a leading dimension. The computation runs on
        the device of the pictures, without synchronisation.

    Args:
        layers: the background, then the objects from back to front.
        height: rows of the view.
        width: columns of the view.
        frames: clocks of the clip.

    Raises:
        ValueError: there are no layers, the background has a mask or an object has none, the pictures differ in their
            number of channels, or a size is below 1.

    Example:
        >>> picture = torch.rand(3, 40, 40)
        >>> scene = Scene([Layer(picture, Motion(velocity=(0.25, 0.0)), position=(-4, -4))], 32, 32)
        >>> bool((scene.rgb(20) == picture[:, 4:36, 4:36]).all())
        True
        >>> scene.light("RGGB", scale=4, alpha=0.4).shape
        torch.Size([41, 8, 8])
        >>> scene.flow(40, scale=4)[:, 0, 0].tolist()
        [1.25, 0.0]
    """

    def __init__(self, layers: Sequence[Layer], height: int, width: int, frames: int = 41) -> None:
        if not layers or layers[0].mask is not None or any(layer.mask is None for layer in layers[1:]):
            raise ValueError("layers: expected a background without a mask, then objects with one")
        kinds = {(layer.picture.shape[:-3], layer.picture.shape[-3]) for layer in layers}
        if len(kinds) > 1:
            raise ValueError(f"layers: expected pictures of one number of channels and scenes, got {kinds}")
        ((self._batch, self.channels),) = kinds
        if height < 1 or width < 1 or frames < 1:
            raise ValueError(f"height, width, frames: expected at least 1, got {height}, {width}, {frames}")
        self.layers = list(layers)
        self.height, self.width = height, width
        self.frames, self.middle = frames, frames // 2
        self._planes = [layer._planes() for layer in layers]

    def rgb(self, clock: float) -> Tensor:
        """Return the view at a clock.

        Args:
            clock: any number; the sensor sees the whole numbers from 0 to ``frames - 1``.

        Returns:
            ``rgb`` of shape (3, height, width), or (1, height, width) if the pictures have one channel.
        """
        rows, columns = _axis(self.height), _axis(self.width)
        view = self._render(self._picked([*range(self.channels)]), self._moves([clock]), rows, columns).squeeze(2)
        return view if self._batch else view[0]

    def light(self, pattern: Pattern = "RGGB", *, scale: int, alpha: float = 0.4) -> Tensor:
        """Return the light that arrives at the sensor at every clock.

        Equals ``alpha * bin_to_sensor(scene.rgb(clock), pattern, scale=scale)``, but evaluates only the colour that the
        sensor sees at each view pixel.

        Args:
            pattern: Bayer phase, see :func:`spikekit.bayer_pattern`, or ``"grey"``.
            scale: width of a sensor pixel in view pixels; it divides the view.
            alpha: light of a white pixel per clock.

        Returns:
            ``light`` of shape (frames, height / scale, width / scale).

        Raises:
            ValueError: the pattern is unknown, or a Bayer phase for pictures of one channel; ``scale`` does not divide
                the view; or ``alpha`` is not above 0.
        """
        height, width = self._sensor(scale)
        check_positive("alpha", alpha)
        sites, side = cfa_sites(pattern)
        if self.channels == 1 and side > 1:
            raise ValueError(f"pattern: expected grey for pictures of one channel, got {pattern}")
        scenes, moves = len(self._planes[0][0]), self._moves(range(self.frames))
        light = self.layers[0].picture.new_empty(scenes, self.frames, height, width)
        for colour, row, column in sites:
            rows = _axis(self.height).reshape(height, scale)[row::side].flatten()
            columns = _axis(self.width).reshape(width, scale)[column::side].flatten()
            if 0 in (len(rows), len(columns)):
                continue
            picked = self._picked([colour] if side > 1 else [*range(self.channels)])
            most = _CHUNK if light.device.type == "cpu" else _CHUNK_ELSEWHERE
            chunk = max(1, most // (scenes * len(rows) * len(columns)))
            for start in range(0, self.frames, chunk):
                clocks = slice(start, min(start + chunk, self.frames))
                now = [(turn[:, clocks], shift[:, clocks]) for turn, shift in moves]
                seen = self._render(picked, now, rows, columns)
                seen = seen[:, 0] if side > 1 else bin_to_sensor(seen.movedim(1, 2), pattern, scale=1)
                light[:, clocks, row::side, column::side] = F.avg_pool2d(seen, scale)
        light = light.mul_(alpha)
        return light if self._batch else light[0]

    def flow(self, clock: float, *, scale: int) -> Tensor:
        """Return the true flow from the middle to a clock, at the sensor's resolution.

        Convention:
            In sensor pixels, order (x, y). The flow of a sensor pixel is the motion of the layer visible at its centre
            at the middle of the clip; an object counts as visible if its mask is at least one half.

        Args:
            clock: target clock.
            scale: width of a sensor pixel in view pixels; it divides the view.

        Returns:
            ``flow`` of shape (2, height / scale, width / scale).

        Raises:
            ValueError: ``scale`` does not divide the view.
        """
        height, width = self._sensor(scale)
        rows, columns = _axis(height) * scale + (scale - 1) / 2, _axis(width) * scale + (scale - 1) / 2
        device = self.layers[0].picture.device
        here = (columns + 1j * rows[:, None]).to(device)
        still = Motion()._turn_and_shift(torch.zeros(1, dtype=torch.float64, device="cpu"))
        moved = torch.zeros_like(here)
        for (planes, corner), moves in zip(self._planes, self._moves([clock]), strict=True):
            turn, shift = (part.to(device)[..., None] for part in moves)
            away = turn * here + shift - here
            if planes.shape[1] > self.channels:
                seen = _sample(planes[:, -1:], corner, *still, rows, columns, "border")[:, 0, 0] >= 0.5
                away = torch.where(seen, away, moved)
            moved = away
        flow = torch.stack([moved.real, moved.imag], dim=1).to(self.layers[0].picture.dtype) / scale
        return flow.expand(len(self._planes[0][0]), -1, -1, -1) if self._batch else flow[0]

    def _moves(self, clocks: Sequence[float]) -> list[tuple[Tensor, Tensor]]:
        """Return the turns and shifts of every layer, on the CPU."""
        tau = torch.tensor(list(clocks), dtype=torch.float64, device="cpu") - self.middle
        return [layer.motion._turn_and_shift(tau) for layer in self.layers]

    def _picked(self, colours: list[int]) -> list[Tensor]:
        """Return some colours of every layer, and the masks of objects."""
        chosen = slice(colours[0], colours[-1] + 1)
        return [
            planes[:, chosen] if n == 0 else torch.cat([planes[:, chosen], planes[:, -1:]], dim=1)
            for n, (planes, _) in enumerate(self._planes)
        ]

    def _sensor(self, scale: int) -> tuple[int, int]:
        scale = check_whole("scale", scale)
        if self.height % scale or self.width % scale:
            raise ValueError(f"scale: expected a divisor of the view {self.height} x {self.width}, got {scale}")
        return self.height // scale, self.width // scale

    def _render(
        self, picked: list[Tensor], moves: list[tuple[Tensor, Tensor]], rows: Tensor, columns: Tensor
    ) -> Tensor:
        """Evaluate some colours at ``rows`` x ``columns`` of the view: (B, colours, T, rows, columns)."""
        view = None
        for planes, (_, corner), (turn, shift) in zip(picked, self._planes, moves, strict=True):
            if view is None:
                view = _sample(planes, corner, turn, shift, rows, columns, "reflection")
                continue
            box = _touched(planes, corner, turn, shift, rows, columns)
            part = view[(..., *box)]
            if part.numel():
                found = _sample(planes, corner, turn, shift, rows[box[0]], columns[box[1]], "border")
                part.lerp_(found[:, :-1], found[:, -1:].expand(part.shape))
        return view


def _axis(length: int) -> Tensor:
    return torch.arange(length, dtype=torch.float64, device="cpu")


def _touched(
    planes: Tensor, corner: Tensor, turn: Tensor, shift: Tensor, rows: Tensor, columns: Tensor
) -> tuple[slice, slice]:
    """Return the rows and columns of the view that moved planes can cover, in any scene and at any clock."""
    height, width = planes.shape[-2:]
    ends = corner + turn.new_tensor([0, width - 1, 1j * (height - 1), width - 1 + 1j * (height - 1)])
    ends = turn[..., None] * ends[:, None, :] + shift[..., None]

    def between(axis: Tensor, position: Tensor) -> slice:
        low, high = torch.searchsorted(axis.contiguous(), torch.stack([position.amin(), position.amax() + 1]))
        return slice(int(low), int(high))

    return between(rows, ends.imag), between(columns, ends.real)

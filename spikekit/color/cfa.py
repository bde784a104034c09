"""The colour filter array: Bayer phases, masks, and conversion between pictures, mosaics and sub-streams."""

from __future__ import annotations

from enum import Enum
from typing import TypeAlias

import torch
from torch import Tensor
from torch.compiler import is_exporting

from spikekit.check import check_planes, check_whole
from spikekit.options_module import OptionsModule

#: Name of a Bayer phase, ``"grey"``, or a ``kornia.color.CFA``, whose import takes a quarter of a second.
Pattern: TypeAlias = str | Enum

#: Bayer phases by name, read along the rows of the top-left 2 x 2 cell.
PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")

#: The pattern of a sensor without colour filters.
GREY = "grey"

_PATTERN_OF_CFA = {"BG": "RGGB", "RG": "BGGR", "GB": "GRBG", "GR": "GBRG"}


def bayer_pattern(pattern: Pattern) -> str:
    """Return the name of a Bayer phase.

    Args:
        pattern: one of :data:`PATTERNS`, or a :class:`kornia.color.CFA`, whose members are named after the pixel at
            (1, 1) as in OpenCV: ``CFA.BG`` is RGGB.

    Returns:
        One of :data:`PATTERNS`.

    Raises:
        ValueError: the pattern is unknown.

    Example:
        >>> from kornia.color import CFA
        >>> bayer_pattern(CFA.BG), bayer_pattern("bggr")
        ('RGGB', 'BGGR')
    """
    name = _PATTERN_OF_CFA.get(pattern.name, pattern) if isinstance(pattern, Enum) else pattern
    name = name.upper() if isinstance(name, str) else name
    if name not in PATTERNS:
        raise ValueError(f"pattern: expected one of {', '.join(PATTERNS)} or a kornia.color.CFA, got {pattern!r}")
    return name


def cfa_pattern(pattern: Pattern) -> str:
    """Return the name of a Bayer phase, see :func:`bayer_pattern`, or :data:`GREY`."""
    if isinstance(pattern, str) and pattern.lower() == GREY:
        return GREY
    try:
        return bayer_pattern(pattern)
    except ValueError:
        names = ", ".join((*PATTERNS, GREY))
        raise ValueError(f"pattern: expected one of {names} or a kornia.color.CFA, got {pattern!r}") from None


def count_colors(pattern: Pattern) -> int:
    """Return the number of colours of a sensor: 3 with a Bayer filter, 1 if it is grey."""
    return 1 if cfa_pattern(pattern) == GREY else 3


def cfa_sites(pattern: Pattern) -> tuple[tuple[tuple[int, int, int], ...], int]:
    """Return the sites of a cell, see :func:`bayer_sites`, and its side: 2, or 1 if the sensor is grey."""
    return (((0, 0, 0),), 1) if cfa_pattern(pattern) == GREY else (bayer_sites(pattern), 2)


def bayer_sites(pattern: Pattern) -> tuple[tuple[int, int, int], ...]:
    """Return ``(colour, row, column)`` of R, G1, G2 and B in the 2 x 2 cell; colour is 0, 1, 2 for R, G, B.

    G1 is the green pixel of the upper row, G2 that of the lower row.

    Args:
        pattern: Bayer phase, see :func:`bayer_pattern`.

    Returns:
        Four triples, in the order R, G1, G2, B.

    Raises:
        ValueError: the pattern is unknown.

    Example:
        >>> bayer_sites("BGGR")
        ((0, 1, 1), (1, 0, 1), (1, 1, 0), (2, 0, 0))
    """
    name = bayer_pattern(pattern)
    sites = [("RGB".index(letter), i // 2, i % 2) for i, letter in enumerate(name)]
    return tuple(sorted(sites, key=lambda site: site[0]))


class PatternModule(OptionsModule):
    """Base class of modules with a pattern, see :func:`bayer_pattern`."""

    def __init__(self, pattern: Pattern = "RGGB") -> None:
        super().__init__()
        self.pattern = cfa_pattern(pattern)


def bayer_mask(
    height: int,
    width: int,
    pattern: Pattern = "RGGB",
    *,
    scale: int = 1,
    device: torch.device | str | None = None,
    dtype: torch.dtype | None = None,
) -> Tensor:
    r"""Mask of the known pixels of a sensor for each colour, optionally after upsampling.

    .. math:: M_C(x, y) = [\text{the sensor's pixel } (\lfloor x / s \rfloor, \lfloor y / s \rfloor)
        \text{ sees the colour } C]

    Convention:
        Planes are R, G, B. One known sensor pixel becomes a block of ``scale`` x ``scale`` known pixels. The three
        planes add up to one everywhere. The pattern starts at the top left, pixel (0, 0); with an odd size the last
        cell is cut. Every pixel of a grey sensor is known, in a single plane. A constant, without gradient.

    Args:
        height: rows of the sensor.
        width: columns of the sensor.
        pattern: Bayer phase or ``"grey"``, see :func:`bayer_pattern`.
        scale: super-resolution factor.
        device: device of the mask.
        dtype: dtype of the mask; default: torch's default.

    Returns:
        Zeros and ones of shape :math:`(3, scale \cdot height, scale \cdot width)`, or :math:`(1, ...)` if the sensor
        is grey.

    Raises:
        TypeError: ``dtype`` is not a torch dtype.
        ValueError: a size or the scale is below 1, or the pattern is unknown.

    Example:
        >>> bayer_mask(2, 2, "RGGB", dtype=torch.uint8).tolist()
        [[[1, 0], [0, 0]], [[0, 1], [1, 0]], [[0, 0], [0, 1]]]
        >>> bayer_mask(2, 2, "RGGB", scale=2, dtype=torch.uint8)[0].tolist()
        [[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]

    Reference:
        Dong et al., Super-Resolution Reconstruction from Bayer-Pattern Spike Streams, CVPR 2024, Fig. 5 (b).
    """
    if not (dtype is None or isinstance(dtype, torch.dtype)):
        raise TypeError(f"dtype: expected a type of torch, got {dtype!r}")
    scale = check_whole("scale", scale)
    height, width = check_whole("height", height), check_whole("width", width)
    sites, side = cfa_sites(pattern)
    rows = torch.arange(scale * height, device=device) // scale % side
    columns = torch.arange(scale * width, device=device) // scale % side
    planes: list[Tensor | None] = [None] * count_colors(pattern)
    for colour, row, column in sites:
        site = (rows == row)[:, None] & (columns == column)[None, :]
        plane = planes[colour]
        planes[colour] = site if plane is None else plane | site
    return torch.stack(planes).to(dtype or torch.get_default_dtype())  # type: ignore[arg-type]


class BayerMask(PatternModule):
    r"""See the Convention block on :func:`bayer_mask`.

    Shape:
        - Input: any tensor :math:`(*, H, W)`; only its size, device and dtype are read.
        - Output: :math:`(3, scale \cdot H, scale \cdot W)`, or :math:`(1, ...)` if the sensor is grey.

    Example:
        >>> BayerMask("GRBG", scale=2)(torch.zeros(1, 41, 4, 6)).shape
        torch.Size([3, 8, 12])
    """

    def __init__(self, pattern: Pattern = "RGGB", *, scale: int = 1) -> None:
        super().__init__(pattern)
        self.scale = check_whole("scale", scale)

    def forward(self, raw: Tensor) -> Tensor:  # noqa: D102
        check_planes("raw", raw, 2, "(*, H, W)")
        height, width = raw.shape[-2:]
        return bayer_mask(height, width, self.pattern, scale=self.scale, device=raw.device, dtype=raw.dtype)


def mosaic(rgb: Tensor, pattern: Pattern = "RGGB") -> Tensor:
    r"""Sample a picture by a colour filter array: one colour per pixel, or the luminance for a grey sensor.

    .. math:: R(x, y) = I_{C(x, y)}(x, y)

    Convention:
        C(x, y) is the colour of :func:`bayer_mask`. Values are copied, in any real dtype, as by
        :func:`kornia.color.rgb_to_raw`, but without the channel axis. The other two colours of a pixel are ignored,
        even NaN, and get gradient 0. For a grey sensor see :func:`bin_to_sensor`.

    Args:
        rgb: colour image :math:`(*, 3, H, W)`; odd sizes are legal.
        pattern: Bayer phase or ``"grey"``, see :func:`bayer_pattern`.

    Returns:
        The mosaic :math:`(*, H, W)`, in the dtype of ``rgb``.

    Raises:
        TypeError: ``rgb`` is not a tensor of real numbers.
        ValueError: ``rgb`` does not have three channels, or the pattern is unknown.

    Example:
        >>> mosaic(torch.tensor([1.0, 2.0, 3.0]).reshape(3, 1, 1).expand(3, 2, 2)).tolist()
        [[1.0, 2.0], [2.0, 3.0]]

    Reference:
        Bayer, Color imaging array, US patent 3,971,065, 1976.
    """
    return bin_to_sensor(rgb, pattern, scale=1)


class Mosaic(PatternModule):
    r"""See the Convention block on :func:`mosaic`.

    Shape:
        - Input: :math:`(*, 3, H, W)`
        - Output: :math:`(*, H, W)`

    Example:
        >>> Mosaic("BGGR")(torch.rand(2, 3, 4, 4)).shape
        torch.Size([2, 4, 4])
    """

    def forward(self, rgb: Tensor) -> Tensor:  # noqa: D102
        return mosaic(rgb, self.pattern)


def bin_to_sensor(rgb: Tensor, pattern: Pattern = "RGGB", *, scale: int) -> Tensor:
    r"""Average a high-resolution picture to the mosaic of a sensor with ``scale`` times coarser pixels.

    .. math:: R(x, y) = \frac{1}{s^2} \sum_{0 \le a, b < s} I_{C(x, y)}(s x + a, s y + b)

    Convention:
        The sensor pixel (x, y) covers the block that starts at (s x, s y), and averages the values of its own colour
        C(x, y). The sum is computed in float32 or wider. The gradient of a picture pixel is :math:`1 / s^2` of that of
        its sensor pixel in this colour, and 0 in the other two.

        A grey sensor sees the Rec. 601 luminance of the encoded values, :math:`0.299 R + 0.587 G + 0.114 B`, as in the
        grey simulations of the literature. A single channel is taken as it is.

    Args:
        rgb: colour image :math:`(*, 3, H, W)`, H and W multiples of ``scale``; for a grey sensor also
            :math:`(*, 1, H, W)`.
        pattern: Bayer phase of the sensor or ``"grey"``, see :func:`bayer_pattern`.
        scale: width of a sensor pixel in picture pixels.

    Returns:
        The mosaic :math:`(*, H / s, W / s)`, in the dtype of ``rgb``. Integer pictures are accepted if nothing is
        averaged: ``scale=1``, and a Bayer sensor or a single channel.

    Raises:
        TypeError: ``rgb`` is not a tensor of real numbers, or not floating although values are averaged.
        ValueError: ``rgb`` has another number of channels, ``scale`` is below 1 or does not divide the size, or the
            pattern is unknown.

    Example:
        >>> bin_to_sensor(torch.arange(48.0).reshape(3, 4, 4), scale=2).tolist()
        [[2.5, 20.5], [26.5, 44.5]]
        >>> bin_to_sensor(torch.tensor([1.0, 0.5, 0.0]).reshape(3, 1, 1), "grey", scale=1)
        tensor([[0.5925]])

    Reference:
        Dong et al., CVPR 2024, section 5.1: "accumulate signals of 4 pixels to generate the signal of one target
        pixel in the x2 case ... the 4 pixels come from one of the channels".
    """
    scale = check_whole("scale", scale)
    sites, side = cfa_sites(pattern)
    luminance = side == 1 and isinstance(rgb, Tensor) and rgb.ndim >= 3 and rgb.shape[-3] == 3
    shape = "(*, 1 or 3, H, W)" if side == 1 else "(*, 3, H, W)"
    check_planes("rgb", rgb, 3, shape, floating=scale > 1 or luminance)
    channels, height, width = rgb.shape[-3:]
    if channels not in ((1, 3) if side == 1 else (3,)) or height % scale or width % scale:
        multiples = f" with H and W multiples of {scale}" if scale > 1 else ""
        raise ValueError(f"rgb: expected {shape}{multiples}, got {tuple(rgb.shape)}")
    wide = torch.promote_types(rgb.dtype, torch.float32)
    dtype = rgb.dtype
    if luminance:
        from kornia.color import rgb_to_grayscale

        rgb = rgb_to_grayscale(rgb.to(wide))
    raw = rgb.new_empty(*rgb.shape[:-3], height // scale, width // scale, dtype=dtype)
    for colour, row, column in sites:
        plane, step = rgb[..., colour, :, :], side * scale
        seen = _sum([plane[..., scale * row + a :: step, :] for a in range(scale)], wide)
        seen = _sum([seen[..., scale * column + b :: step] for b in range(scale)], wide)
        raw[..., row::side, column::side] = seen / scale**2 if scale > 1 else seen
    return raw


def _sum(parts: list[Tensor], dtype: torch.dtype) -> Tensor:
    # stacked, as torch.compile would add guards on the strides of two views
    return torch.stack(parts).sum(dim=0, dtype=dtype) if len(parts) > 1 else parts[0]


class BinToSensor(PatternModule):
    r"""See the Convention block on :func:`bin_to_sensor`.

    Shape:
        - Input: :math:`(*, 3, H, W)`
        - Output: :math:`(*, H / scale, W / scale)`

    Example:
        >>> BinToSensor(scale=4)(torch.rand(2, 3, 16, 8)).shape
        torch.Size([2, 4, 2])
    """

    def __init__(self, pattern: Pattern = "RGGB", *, scale: int) -> None:
        super().__init__(pattern)
        self.scale = check_whole("scale", scale)

    def forward(self, rgb: Tensor) -> Tensor:  # noqa: D102
        return bin_to_sensor(rgb, self.pattern, scale=self.scale)


def split_colors(raw: Tensor, pattern: Pattern = "RGGB") -> Tensor:
    r"""Split a mosaic, or a stream of mosaics, into full-size planes with one colour each and 0 elsewhere.

    .. math:: S^C = M_C \, S, \quad C \in \{R, G, B\}

    Convention:
        M is the mask of :func:`bayer_mask`. The colour is the **first** axis of the result, so that
        ``red, green, blue = split_colors(spikes)`` keeps time at -3. The planes add up to the input. The gradient of a
        pixel is that of its own colour's plane. A grey sensor has one colour.

    Args:
        raw: mosaic or spike stream :math:`(*, H, W)`, any dtype.
        pattern: Bayer phase or ``"grey"``, see :func:`bayer_pattern`.

    Returns:
        :math:`(3, *, H, W)`, or :math:`(1, *, H, W)` if the sensor is grey, in the dtype of ``raw``.

    Raises:
        TypeError: ``raw`` is not a tensor of real numbers.
        ValueError: ``raw`` has fewer than two dimensions, or the pattern is unknown.

    Example:
        >>> red, green, blue = split_colors(torch.tensor([[1, 2], [3, 4]]))
        >>> green.tolist()
        [[0, 2], [3, 0]]

    Reference:
        Dong et al., CVPR 2024, section 4.2.
    """
    check_planes("raw", raw, 2, "(*, H, W)")
    if count_colors(pattern) == 1:
        return raw[None].clone()
    if is_exporting():  # assignments would be exported as scattering
        masks = bayer_mask(*raw.shape[-2:], pattern, device=raw.device, dtype=raw.dtype)
        return raw * masks.reshape(3, *[1] * (raw.ndim - 2), *raw.shape[-2:])
    colors = raw.new_zeros(3, *raw.shape)
    for colour, row, column in bayer_sites(pattern):
        colors[colour, ..., row::2, column::2] = raw[..., row::2, column::2]
    return colors


class SplitColors(PatternModule):
    r"""See the Convention block on :func:`split_colors`.

    Shape:
        - Input: :math:`(*, H, W)`
        - Output: :math:`(3, *, H, W)`

    Example:
        >>> SplitColors()(torch.ones(2, 41, 8, 6)).shape
        torch.Size([3, 2, 41, 8, 6])
    """

    def forward(self, raw: Tensor) -> Tensor:  # noqa: D102
        return split_colors(raw, self.pattern)


def split_bayer(raw: Tensor, pattern: Pattern = "RGGB") -> Tensor:
    r"""Split a mosaic, or a stream of mosaics, into its four half-size sub-streams R, G1, G2, B.

    .. math:: S^k(x, y) = S(2 x + \text{column}_k, 2 y + \text{row}_k)

    Convention:
        The sub-stream is the **first** axis of the result, so that ``r, g1, g2, b = split_bayer(spikes)`` keeps time at
        -3. Rows and columns are those of :func:`bayer_sites`: G1 is the green pixel of the upper row of the cell, G2
        that of the lower row. A permutation of pixels, and differentiable as such. :func:`merge_bayer` is the inverse.

    Args:
        raw: mosaic or spike stream :math:`(*, H, W)`, any dtype, H and W even.
        pattern: Bayer phase, see :func:`bayer_pattern`.

    Returns:
        :math:`(4, *, H / 2, W / 2)`, in the dtype of ``raw``.

    Raises:
        TypeError: ``raw`` is not a tensor of real numbers.
        ValueError: ``raw`` has fewer than two dimensions, H or W is odd, or the pattern is unknown.

    Example:
        >>> r, g1, g2, b = split_bayer(torch.tensor([[1, 2], [3, 4]]), "GBRG")
        >>> r.item(), g1.item(), g2.item(), b.item()
        (3, 1, 4, 2)

    Reference:
        Dong et al., CVPR 2024, section 4.3, joint motion estimation.
    """
    check_planes("raw", raw, 2, "(*, H, W)")
    if raw.shape[-2] % 2 or raw.shape[-1] % 2:
        raise ValueError(f"raw: expected (*, H, W) with H and W even, got {tuple(raw.shape)}")
    return torch.stack([raw[..., row::2, column::2] for _, row, column in bayer_sites(pattern)])


class SplitBayer(PatternModule):
    r"""See the Convention block on :func:`split_bayer`.

    Shape:
        - Input: :math:`(*, H, W)`
        - Output: :math:`(4, *, H / 2, W / 2)`

    Example:
        >>> SplitBayer()(torch.ones(2, 41, 8, 6)).shape
        torch.Size([4, 2, 41, 4, 3])
    """

    def forward(self, raw: Tensor) -> Tensor:  # noqa: D102
        return split_bayer(raw, self.pattern)


def merge_bayer(planes: Tensor, pattern: Pattern = "RGGB") -> Tensor:
    r"""Merge the four sub-streams R, G1, G2, B into one mosaic; the inverse of :func:`split_bayer`.

    .. math:: S(2 x + \text{column}_k, 2 y + \text{row}_k) = S^k(x, y)

    Convention:
        The sub-stream is the **first** axis of the input, in the order and at the sites of :func:`bayer_sites`. A
        permutation of pixels, and differentiable as such.

    Args:
        planes: :math:`(4, *, H, W)`, any dtype.
        pattern: Bayer phase, see :func:`bayer_pattern`.

    Returns:
        :math:`(*, 2 H, 2 W)`, in the dtype of ``planes``.

    Raises:
        TypeError: ``planes`` is not a tensor of real numbers.
        ValueError: ``planes`` has fewer than three dimensions or a first axis whose length is not 4, or the pattern is
            unknown.

    Example:
        >>> raw = torch.rand(5, 4, 6)
        >>> bool((merge_bayer(split_bayer(raw, "GRBG"), "GRBG") == raw).all())
        True
    """
    check_planes("planes", planes, 2, "(4, *, H, W)")
    if planes.ndim < 3 or planes.shape[0] != 4:
        raise ValueError(f"planes: expected (4, *, H, W), got {tuple(planes.shape)}")
    cell = [planes[0]] * 4
    for plane, (_, row, column) in zip(planes, bayer_sites(pattern), strict=True):
        cell[2 * row + column] = plane
    rows = torch.stack(cell[:2], dim=-1).flatten(-2), torch.stack(cell[2:], dim=-1).flatten(-2)
    return torch.stack(rows, dim=-2).flatten(-3, -2)


class MergeBayer(PatternModule):
    r"""See the Convention block on :func:`merge_bayer`.

    Shape:
        - Input: :math:`(4, *, H, W)`
        - Output: :math:`(*, 2 H, 2 W)`

    Example:
        >>> MergeBayer()(torch.ones(4, 41, 4, 3)).shape
        torch.Size([41, 8, 6])
    """

    def forward(self, planes: Tensor) -> Tensor:  # noqa: D102
        return merge_bayer(planes, self.pattern)

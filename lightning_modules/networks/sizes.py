"""Named sizes of CSCSR; the paper does not specify widths and depths."""

from __future__ import annotations

from typing import Any

#: as in the paper: refinement and reconstruction at the resolution of the picture
_FULL = {"resolution": "output", "blocks": 1}
#: at sensor resolution, with the temporal pixels of each sensor pixel as channels: a fraction of the work
_SENSOR = {"resolution": "sensor", "blocks": 1}
_CLIP = dict(_SENSOR, width=32, representation_width=16, features=2, stages=3)

#: fields of :class:`lightning_modules.networks.CSCSRConfig` by size. Parameters, and million multiplications per sensor
#: pixel, at x4: without motion, nano 0.15 M and 0.037, and micro 0.66 M and 0.16; tiny 0.30 M and 0.36, small 1.08 M
#: and 1.48, base 1.32 M and 1.72, huge 3.78 M and 4.18, full_small 0.17 M and 1.86, full_base 0.73 M and 9.06,
#: full_large 2.83 M and 42.7. At x1 for a grey sensor: small_x1 0.53 M and 0.67, large_x1 1.72 M and 2.02. Sizes for x1
#: have more features, as there is one temporal pixel per sensor pixel
SIZES: dict[str, dict[str, Any]] = {
    "nano": dict(_CLIP, resolution="cell", width=32, end_blocks=2),
    "micro": dict(_CLIP, resolution="cell", width=64, end_blocks=6),
    "tiny": dict(_SENSOR, stride=6, width=24, representation_width=8, features=1, stages=2, end_blocks=1),
    "small": dict(_CLIP, end_blocks=3),
    "base": dict(_CLIP, end_blocks=16),
    "huge": dict(_CLIP, end_blocks=16, end_width=96),
    "small_x1": dict(_SENSOR, width=32, representation_width=16, features=6, stages=1, end_blocks=10, end_width=48),
    "large_x1": dict(_SENSOR, width=48, representation_width=24, features=8, stages=1, end_blocks=20, end_width=64),
    "full_small": dict(_FULL, width=16, representation_width=16, features=2, stages=2, end_blocks=2),
    "full_base": dict(_FULL, width=32, representation_width=32, features=4, stages=3, end_blocks=3),
    "full_large": dict(_FULL, width=64, representation_width=32, features=8, stages=3, end_blocks=4, blocks=2),
}


def default_stride(frames: int, window: int) -> int:
    """Return the stride that gives eleven time points, or the next larger number that fits.

    Example:
        >>> default_stride(41, 11), default_stride(101, 11), default_stride(23, 11)
        (3, 9, 1)
    """
    between = frames - window
    return max((stride for stride in range(1, between // 10 + 1) if between % stride == 0), default=1)

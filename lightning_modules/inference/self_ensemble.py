"""Self-ensemble: the mean of a network's pictures of a mirrored, rotated and transposed clip."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.color.cfa import GREY


class _View(NamedTuple):
    top_down: bool
    left_right: bool
    transposed: bool


# in order of their gain: transposition, half turn, single mirrors
_VIEWS = [_View(*mirrored, transposed) for mirrored in ((0, 0), (1, 1), (0, 1), (1, 0)) for transposed in (0, 1)]

#: supported numbers of views
COUNTS = (1, 2, 4, 8)


def self_ensemble(
    run: Callable[[Tensor, Tensor | None], Tensor],
    spikes: Tensor,
    flow: Tensor | None,
    pattern: str,
    scale: int,
    views: int,
) -> Tensor:
    r"""Return the mean of the pictures of transformed clips.

    Two views are the clip and its transpose; four also have their half turns; eight also have the single mirrors.
    A network takes one Bayer phase only. If a view would change the phase, the outermost sensor pixels at both ends
    are cropped, and the mean there is over the remaining views.

    Args:
        run: function that returns a picture :math:`(B, 3, s H, s W)` for spikes :math:`(B, N, H, W)` and a flow.
        spikes: :math:`(B, N, H, W)`.
        flow: from the middle to the first and the last time point, :math:`(B, 2, 2, H, W)`, or ``None``.
        pattern: Bayer phase of the clip.
        scale: super-resolution factor s.
        views: 1, 2, 4 or 8.

    Returns:
        rgb :math:`(B, 3, s H, s W)`.

    Raises:
        ValueError: the clip is smaller than 5 x 5 sensor pixels.

    Reference:
        Timofte et al., Seven Ways to Improve Example-Based Single Image Super Resolution, CVPR 2016.
    """
    if views == 1:
        return run(spikes, flow)
    height, width = spikes.shape[-2:]
    if min(height, width) < 5:
        raise ValueError(f"self_ensemble: expected at least 5 x 5 sensor pixels, got {height} x {width}")
    total = run(spikes, flow)
    count = total.new_ones(total.shape[-2:])
    for view in _VIEWS[1:views]:
        top, left = _margins(view, height, width, pattern)
        inside = slice(top, height - top), slice(left, width - left)
        picture = run(_seen(spikes[..., *inside], view), None if flow is None else _moved(flow[..., *inside], view))
        picture = _seen(picture, view, back=True)
        border = scale * left, scale * left, scale * top, scale * top
        total = total + F.pad(picture, border)
        count = count + F.pad(torch.ones_like(picture[0, 0]), border)
    return total / count


def _margins(view: _View, height: int, width: int, pattern: str) -> tuple[int, int]:
    """Return the sensor pixels to crop above and below, and left and right, to keep the Bayer phase."""
    if pattern == GREY:
        return 0, 0
    row, column = divmod(pattern.index("R"), 2)
    seen_row = height - 1 - row if view.top_down else row
    seen_column = width - 1 - column if view.left_right else column
    to_row, to_column = (column, row) if view.transposed else (row, column)
    return (seen_row - to_row) % 2, (seen_column - to_column) % 2


def _seen(planes: Tensor, view: _View, back: bool = False) -> Tensor:
    """Mirror planes, then transpose them; or the inverse."""
    if back and view.transposed:
        planes = planes.mT
    planes = planes.flip([axis for axis, mirrored in ((-2, view.top_down), (-1, view.left_right)) if mirrored])
    return planes if back or not view.transposed else planes.mT.contiguous()


def _moved(flow: Tensor, view: _View) -> Tensor:
    """Return the flow (*, 2, H, W) of a view: its vectors (x, y) are mirrored and transposed like the picture."""
    signs = flow.new_tensor([-1.0 if view.left_right else 1.0, -1.0 if view.top_down else 1.0])
    flow = _seen(flow * signs[:, None, None], view)
    return flow.flip(-3) if view.transposed else flow

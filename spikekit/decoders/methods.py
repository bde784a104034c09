"""The decoders by name, a list shared by the commands, the baseline network and its tables."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from torch import Tensor

from spikekit.decoders.dense import tfi, tfp
from spikekit.decoders.single_frame import search, tfi_at, tfp_at, tfp_weights


@dataclass(frozen=True)
class Decoder:
    """A way back from spikes to light, for a clip in memory and for a recording that is read frame by frame.

    Attributes:
        clip: makes raw intensities (*, T, H, W) of spikes of that shape, given its options as keywords.
        frame: the same at one frame of a clip, (*, H, W), given spikes and the number of the frame.
        planes: the same of a recording, as an array (H, W), given what returns the plane of a number, the number,
            the range of frames that it may look at, and how many there are.
        reach: how many frames on each side it looks at in a recording.
        options: names of its options.
        shown: options by heading, for tables that compare methods.
    """

    clip: Callable[..., Tensor]
    frame: Callable[..., Tensor]
    planes: Callable[..., np.ndarray]
    reach: Callable[..., int]
    options: tuple[str, ...] = ()
    shown: dict[str, dict[str, Any]] = field(default_factory=dict)


#: Frames that TFI looks at on each side in a recording; a pixel that fires more rarely is decoded as if it fired once
#: in all of them.
TFI_REACH = 200


def _tfi_planes(plane: Callable[[int], np.ndarray], frame: int, seen: range, frames: int) -> np.ndarray:
    return np.reciprocal(search(plane, frame, seen), dtype=np.float32)


def _tfp_planes(
    plane: Callable[[int], np.ndarray], frame: int, seen: range, frames: int, window: int, order: int = 1
) -> np.ndarray:
    _, weights = tfp_weights(frames, frame, window, order)
    return sum(map(np.multiply, map(plane, seen), weights)).astype(np.float32)


DECODERS = {
    "tfi": Decoder(tfi, tfi_at, _tfi_planes, lambda: TFI_REACH, shown={"TFI": {}}),
    "tfp": Decoder(
        tfp,
        tfp_at,
        _tfp_planes,
        lambda window, order=1: order * (window // 2),
        ("window", "order"),
        {"TFP 41": {"window": 41}, "TFP 13, order 3": {"window": 13, "order": 3}},
    ),
}

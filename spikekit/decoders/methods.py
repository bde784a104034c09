"""Registry of the decoders, shared by the commands and the baselines."""

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
    """A decoder from spikes to light, for clips in memory and for recordings that are read frame by frame.

    Attributes:
        clip: decodes spikes (*, T, H, W) to raw intensities of that shape; takes the options as keywords.
        frame: decodes one frame of a clip to (*, H, W); takes spikes and the frame number.
        planes: decodes one frame of a recording to an array (H, W); takes a function that returns a frame, the frame
            number, the range of frames to use, and the number of frames.
        reach: returns the number of frames used on each side in a recording.
        options: names of the options.
        shown: options by heading, for tables that compare methods.
    """

    clip: Callable[..., Tensor]
    frame: Callable[..., Tensor]
    planes: Callable[..., np.ndarray]
    reach: Callable[..., int]
    options: tuple[str, ...] = ()
    shown: dict[str, dict[str, Any]] = field(default_factory=dict)


#: Frames that TFI searches on each side in a recording; a pixel that fires more rarely is decoded as if spikes lay just
#: outside.
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

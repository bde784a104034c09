"""Examples from a recording: clips, and pictures of them by a larger network, the teacher."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lightning_modules.inference.clips import RecordingClips
from lightning_modules.inference.tiles import TILE, forward_in_tiles
from lightning_modules.networks import Network
from spikekit.progress import progress

#: number of examples, and how many of them, at the end of the recording, are held out
EXAMPLES, HELD_OUT = 16, 4
#: minimum length of a recording, in clips of the network with the longer clips
ROOM = 3

_SIDE = 160  # side of an example in sensor pixels


@dataclass(frozen=True)
class DistillationSet:
    """Clips of the student's length (L, N, H, W), uint8, with pictures and flow; both and ``white`` in its units.

    The pictures are the teacher's, (L, 3, s H, s W), float16; the flow is None if the student estimates none.
    """

    spikes: Tensor
    rgb: Tensor
    flow: Tensor | None
    white: float

    def __len__(self) -> int:
        return len(self.spikes)

    def part(self, which: slice) -> DistillationSet:
        """Return a slice of the examples."""
        flow = None if self.flow is None else self.flow[which]
        return DistillationSet(self.spikes[which], self.rgb[which], flow, self.white)


def chosen_frames(total: int, frames: int) -> list[int]:
    """Return the middle frames of the examples; clips of held-out examples do not overlap with the others.

    Example:
        >>> chosen_frames(1000, 101)[-5:]
        [669, 770, 830, 889, 949]
    """
    first, last = frames // 2, total - (frames + 1) // 2
    held_out = last - (last - first) // 5
    taught = np.linspace(first, held_out - frames, EXAMPLES - HELD_OUT)
    return [round(frame) for frame in [*taught, *np.linspace(held_out, last, HELD_OUT)]]


def make_distillation_set(student: Network, teacher: Network, clips: RecordingClips) -> DistillationSet:
    """Create examples from clips as long as the longer of both networks takes, which share scale and Bayer phase."""
    chosen = chosen_frames(clips.recording.frames, clips.frames)
    ratio = teacher.settings["alpha"] / student.settings["alpha"]
    device, rng = next(teacher.parameters()).device, np.random.default_rng(0)
    sides = [min(side, _SIDE) // 2 * 2 for side in clips.size]
    spikes, pictures, flows = [], [], []
    for _, clip in progress(clips.in_order(chosen), "examples", len(chosen)):
        corner = (2 * int(rng.integers((whole - side) // 2 + 1)) for whole, side in zip(clips.size, sides, strict=True))
        window = tuple(slice(z, z + side) for z, side in zip(corner, sides, strict=True))
        seen = clip[None, ..., *window].to(device)
        pictures.append(forward_in_tiles(teacher, _middle(seen, teacher.frames), TILE).mul(ratio).half().cpu())
        seen = _middle(seen, student.frames).contiguous()
        spikes.append(seen.cpu())
        if student.takes_flow and not student.motion.static:
            with torch.no_grad():
                flows.append(student.estimate_flow(seen).cpu())
    white = clips.joined * clips.white / student.settings["alpha"]
    return DistillationSet(torch.cat(spikes), torch.cat(pictures), torch.cat(flows) if flows else None, white)


def _middle(spikes: Tensor, frames: int) -> Tensor:
    start = spikes.shape[1] // 2 - frames // 2
    return spikes[:, start : start + frames]

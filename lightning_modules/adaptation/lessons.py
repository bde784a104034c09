"""What a network can learn from a recording: the pictures that a slower one makes of it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from lightning_modules.inference.clips import RecordingClips
from lightning_modules.inference.tiles import TILE, forward_in_tiles
from lightning_modules.networks import Network
from spikekit.arguments import one_line
from spikekit.io.failures import no_pipe
from spikekit.io.whole_file import whole_file
from spikekit.progress import progress

#: lessons, and how many of them are held out: pictures of the end of the recording
LESSONS, HELD_OUT = 16, 4
#: clips of the longer of both networks that a recording has to have room for
ROOM = 3

_BRIGHTEST = 100.0  # of a picture, where white is 1
_SHORT = 40  # characters that a message can bear
_SIDE = 160  # of what a lesson shows, in sensor pixels


@dataclass(frozen=True)
class Lessons:
    """Clips of a recording, and what the teacher sees in them.

    Args:
        spikes: (L, N, H, W) uint8, as the student takes them.
        rgb: pictures of the teacher, (L, 3, s H, s W) float16, in the student's units.
        flow: motion as the student's estimator sees it; None where it needs none.
        white: what the student's picture of a white pixel would be.
    """

    spikes: Tensor
    rgb: Tensor
    flow: Tensor | None
    white: float

    def __len__(self) -> int:
        return len(self.spikes)

    def part(self, which: slice) -> Lessons:
        """Return some of them."""
        flow = None if self.flow is None else self.flow[which]
        return Lessons(self.spikes[which], self.rgb[which], flow, self.white)

    def write(self, path: Path, identity: dict[str, Any]) -> None:
        """Write a file that also says what the lessons are of."""
        tensors = {"spikes": self.spikes, "rgb": self.rgb, "white": torch.tensor(self.white, dtype=torch.float64)}
        tensors |= {} if self.flow is None else {"flow": self.flow}
        tensors = {name: value.contiguous() for name, value in tensors.items()}
        with whole_file(path) as file:
            file.write(save(tensors, {"lessons": json.dumps(identity)}))

    def check(self) -> None:
        """Refuse what no recording and no network gives.

        Raises:
            ValueError: other shapes or dtypes, spikes that are neither 0 nor 1, pictures or flow that are not finite or
                too large, a white that is not above 0.
        """
        count, height, width = self.spikes.shape[0], *self.spikes.shape[-2:]
        _check("spikes", self.spikes, (count, *self.spikes.shape[1:2], height, width), torch.uint8, 1)
        scale = self.rgb.shape[-1] // width
        _check("rgb", self.rgb, (count, self.rgb.shape[1], scale * height, scale * width), torch.float16, _BRIGHTEST)
        if self.flow is not None:
            _check("flow", self.flow, (count, *self.flow.shape[1:-2], height, width), torch.float32, height + width)
        if count <= HELD_OUT or not 0 < self.white < float("inf"):
            raise ValueError(f"expected more than {HELD_OUT} clips and white above 0, got {count} and {self.white}")

    @classmethod
    def read(cls, path: Path, identity: dict[str, Any]) -> Lessons:
        """Read them again.

        Raises:
            ValueError: a file of something else, or lessons of another adaptation.
        """
        try:
            with safe_open(no_pipe(path), "pt") as file:
                said = json.loads((file.metadata() or {})["lessons"])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            made = cls(tensors["spikes"], tensors["rgb"], tensors.get("flow"), tensors["white"].item())
            made.check()
        except Exception as error:  # what safetensors raises depends on the damage
            raise ValueError(f"{path}: not lessons of lightning adapt ({one_line(error)[:300]})") from error
        for name, value in identity.items():
            if said.get(name) != value:
                short = len(str(value)) < _SHORT
                expected, got = (said.get(name), value) if short else ("that", "another")
                where = f"{expected} of the adaptation in {path.parent}"
                raise ValueError(f"{name}: expected {where}, got {got}; -o goes elsewhere")
        return made


def _check(name: str, values: Tensor, shape: tuple[int, ...], dtype: torch.dtype, most: float) -> None:
    if tuple(values.shape) != shape or values.dtype != dtype:
        raise ValueError(f"{name}: expected {dtype} {shape}, got {values.dtype} {tuple(values.shape)}")
    if not values.float().abs().max() <= most:  # NaN is not
        raise ValueError(f"{name}: expected numbers up to {most:g}")


def chosen_frames(total: int, frames: int) -> list[int]:
    """Return which frames lessons are about; no clip of the last ones, which are held out, overlaps another's.

    Args:
        total: frames of the recording, at least ``ROOM`` clips.
        frames: of the longest clip.

    Example:
        >>> chosen_frames(1000, 101)[-5:]
        [669, 770, 830, 889, 949]
    """
    first, last = frames // 2, total - (frames + 1) // 2
    held_out = last - (last - first) // 5
    taught = np.linspace(first, held_out - frames, LESSONS - HELD_OUT)
    return [round(frame) for frame in [*taught, *np.linspace(held_out, last, HELD_OUT)]]


def make_lessons(student: Network, teacher: Network, clips: RecordingClips) -> Lessons:
    """Let the teacher look at a recording.

    Args:
        student: what is to learn.
        teacher: of the same scale and Bayer phase.
        clips: of the recording, of as many frames as the network with the longer ones takes.
    """
    chosen = chosen_frames(clips.recording.frames, clips.frames)
    ratio = teacher.settings["alpha"] / student.settings["alpha"]
    device, rng = next(teacher.parameters()).device, np.random.default_rng(0)
    sides = [min(side, _SIDE) // 2 * 2 for side in clips.size]
    spikes, pictures, flows = [], [], []
    for _, clip in progress(clips.in_order(chosen), "lessons", len(chosen)):
        corner = (2 * int(rng.integers((whole - side) // 2 + 1)) for whole, side in zip(clips.size, sides, strict=True))
        window = tuple(slice(z, z + side) for z, side in zip(corner, sides, strict=True))
        seen = clip[None, ..., *window].to(device)
        pictures.append(forward_in_tiles(teacher, _middle(seen, teacher.frames), TILE).mul(ratio).half().cpu())
        seen = _middle(seen, student.frames).contiguous()
        spikes.append(seen.cpu())
        if student.takes_flow and not student.motion.static:
            with torch.no_grad():
                flows.append(student.estimate_flow(seen).cpu())
    white = clips.white / student.settings["alpha"]
    return Lessons(torch.cat(spikes), torch.cat(pictures), torch.cat(flows) if flows else None, white)


def _middle(spikes: Tensor, frames: int) -> Tensor:
    start = spikes.shape[1] // 2 - frames // 2
    return spikes[:, start : start + frames]

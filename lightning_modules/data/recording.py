"""Clips of a recording, which has no ground truth."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from pytorch_lightning import LightningDataModule
from torch import Tensor

from lightning_modules.inference.clips import FRAMES, RecordingClips
from spikekit.color.cfa import GREY
from spikekit.recording import open_recording


class RecordingScenes(LightningDataModule):
    """Clips of a recording, for tests without ground truth.

    All arguments of :func:`lightning_modules.reconstruct` that describe a recording are accepted as well.

    Args:
        path: a ``.dat`` or ``.npz`` file, see :func:`spikekit.read_spikes`.
        frame: middle frames of the clips: N, or A to B - 1 as A:B or A:B:STEP. Null for every 20th.
        frames: spike frames of a clip.
    """

    def __init__(self, path: str, *, frame: str | None = None, frames: int = FRAMES, **known: Any) -> None:
        super().__init__()
        self.path, self.frame, self.frames = path, frame, frames
        self.known = known

    def setup(self, stage: str | None = None) -> None:
        """Open the recording, for the stage ``test``."""
        if stage not in (None, "test"):
            raise ValueError(f"data: {stage} needs clips with ground truth, got the recording {self.path}")
        recording = open_recording(self.path, **self.known)
        self.clips = RecordingClips(recording, self.frames, self.frame).in_light()
        self.options = {"pattern": GREY if recording.pattern == GREY else "RGGB"}
        self.test_names = self.clips.chosen

    def test_dataloader(self) -> Iterator[dict[str, Tensor]]:  # noqa: D102
        white, level = self.clips.joined * self.clips.white, self.clips.noise_level
        known = {"white": torch.tensor([white]), "noise": torch.tensor([level])}
        return ({"spikes": clip[None], **known} for _, clip in self.clips.in_order())

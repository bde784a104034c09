"""Recordings in files, cut into clips for ``lightning predict``."""

from __future__ import annotations

from typing import Any

from pytorch_lightning import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from spikekit import bayer_sites, read_spikes, spikes_shape


class RecordingClips(Dataset[dict[str, Any]]):
    """Clips around every ``every``-th frame of a recording, read when they are asked for.

    Args:
        path: a ``.dat`` or ``.npz`` file, see :func:`spikekit.read_spikes`.
        height: rows; needed for ``.dat``.
        width: columns; needed for ``.dat``.
        flip: turn the stored frames upside down, as real cameras need.
        pattern: Bayer phase after the flip.
        frames: spike frames N of a clip.
        every: frames between two clips.
        crop_to: Bayer phase that a network wants; up to one row and column are cut off so that clips begin with it.

    Raises:
        spikekit.SpikeFileError: the file cannot be read.
        ValueError: the recording is shorter than a clip, less than 3 x 3 pixels are left, or an argument is out of
            range.
    """

    def __init__(
        self,
        path: str,
        height: int | None = None,
        width: int | None = None,
        flip: bool = False,
        pattern: str = "RGGB",
        frames: int = 41,
        every: int = 20,
        crop_to: str = "RGGB",
    ) -> None:
        if every < 1:
            raise ValueError(f"every: expected at least 1 frame, got {every}")
        total, self.height, self.width = spikes_shape(path, height, width)
        if total < frames:
            raise ValueError(f"{path}: expected at least {frames} frames for a clip, got {total}")
        # where red is says which of the four phases it is
        (_, row, column), (_, to_row, to_column) = bayer_sites(pattern)[0], bayer_sites(crop_to)[0]
        self.top, self.left = (row - to_row) % 2, (column - to_column) % 2
        left = self.height - self.top, self.width - self.left
        if min(left) < 3:
            raise ValueError(f"{path}: expected at least 3 x 3 pixels that begin with {crop_to}, got {left}")
        self.path, self.flip, self.frames, self.every = path, flip, frames, every
        self.clips = (total - frames) // every + 1

    def __len__(self) -> int:
        return self.clips

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not 0 <= index < self.clips:
            raise IndexError(index)
        start = index * self.every
        spikes: Tensor = read_spikes(
            self.path, self.height, self.width, flip=self.flip, start=start, frames=self.frames
        )
        return {"spikes": spikes[:, self.top :, self.left :].contiguous(), "frame": start + self.frames // 2}


class Recording(LightningDataModule):
    """One recording of a colour spike camera, for ``predict``.

    Args:
        path: a ``.dat`` or ``.npz`` file.
        height: rows; needed for ``.dat``, which has no header.
        width: columns; likewise.
        flip: turn the stored frames upside down, as real cameras need.
        pattern: Bayer phase after the flip, one of RGGB, BGGR, GRBG, GBRG; for a grey camera leave it as it is.
        every: frames between two reconstructed pictures; 20 is a millisecond at 20 kHz.
        frames: spike frames of a clip, as the network was trained.
        crop_to: Bayer phase that the network was trained with; clips begin with it, a row and a column less at most.
    """

    def __init__(
        self,
        path: str,
        height: int | None = None,
        width: int | None = None,
        flip: bool = False,
        pattern: str = "RGGB",
        every: int = 20,
        frames: int = 41,
        crop_to: str = "RGGB",
    ) -> None:
        super().__init__()
        self.path = path
        self.how = {
            "height": height,
            "width": width,
            "flip": flip,
            "pattern": pattern,
            "frames": frames,
            "every": every,
            "crop_to": crop_to,
        }

    def setup(self, stage: str | None = None) -> None:
        """Open the recording.

        Raises:
            spikekit.SpikeFileError: the file cannot be read.
            ValueError: the recording is shorter than a clip, or an argument is out of range.
        """
        self.clips = RecordingClips(self.path, **self.how)

    def predict_dataloader(self) -> DataLoader[dict[str, Any]]:  # noqa: D102
        return DataLoader(self.clips, batch_size=1)

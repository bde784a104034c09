"""Callbacks for super-resolution and optical flow: pictures in TensorBoard and the table of a test."""

from __future__ import annotations

import csv
from collections import defaultdict
from pathlib import Path
from typing import Any

import torch
from pytorch_lightning import Callback, LightningModule, Trainer
from pytorch_lightning.loggers import TensorBoardLogger
from torch import Tensor

from lightning_modules.metrics.image import measures, why_no_lpips
from lightning_modules.networks import ClassicalDecoder
from spikekit import flow_to_rgb, panel, write_picture
from spikekit.io.whole_file import whole_file
from spikekit.tables import table


def middle_clip(batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the clip of a batch with its ground truth; for films, the clip around the middle key frame."""
    if "every" not in batch:
        return batch
    middle = batch["rgb"].shape[1] // 2
    return {name: batch[name][:, middle] for name in ("spikes", "rgb")}


def middle_half(batch: dict[str, Tensor]) -> slice:
    """Return the key frames of a film that are scored: the middle half, which has neighbours on both sides."""
    count = batch["rgb"].shape[1]
    return slice(count // 4, count - count // 4)


class ValidationPictures(Callback):
    """Show the first clips of every validation in TensorBoard: decoded input (TFI), result and truth side by side."""

    title = "tfi, result, truth"
    clips = 4

    def __init__(self) -> None:
        self._rows: list[list[Tensor]] = []

    def rows(self, module: LightningModule, outputs: Any, batch: dict[str, Tensor]) -> list[list[Tensor]]:
        """Return one row of pictures per clip of a batch."""
        settings, batch = module.network.settings, middle_clip(batch)
        decoded = ClassicalDecoder("tfi", settings["scale"], settings["pattern"], settings["alpha"])(batch["spikes"])
        return [list(row) for row in zip(decoded.clamp(0, 1), outputs, batch["rgb"], strict=True)]

    def on_validation_batch_end(  # noqa: D102
        self, trainer: Trainer, module: LightningModule, outputs: Any, batch: dict[str, Tensor], *_: Any
    ) -> None:
        if len(self._rows) < self.clips:
            self._rows += self.rows(module, outputs, batch)[: self.clips - len(self._rows)]

    def on_validation_epoch_end(self, trainer: Trainer, module: LightningModule) -> None:  # noqa: D102
        if self._rows and isinstance(trainer.logger, TensorBoardLogger) and trainer.is_global_zero:
            picture = panel(self._rows)
            trainer.logger.experiment.add_image(f"val/{self.title}", picture, trainer.global_step)
        self._rows = []


class TestReport(Callback):
    """Print the table of a test, with all methods on the same clips, and write ``test.csv`` and ``test.png``.

    The columns are :func:`spikekit.psnr`, :func:`spikekit.ssim` and, if available, LPIPS, averaged over clips, see
    :mod:`lightning_modules.metrics.image`. Without ground truth, as of a recording, they are blur and noise.
    ``test.csv`` also has a row per clip, named after the ``test_names`` of the data if there are any.

    Args:
        output: folder of the run.
    """

    __test__ = False  # not a test for pytest
    truth = True  # whether there is any
    clips = 6  # in the picture

    def __init__(self, output: str | Path) -> None:
        self.output = Path(output)

    def columns(self) -> list[tuple[str, str, int]]:
        """Return columns of ``test.csv``, their headings in the table, and their decimal places there."""
        return [(measure.name, measure.heading, measure.digits) for measure in measures(self.truth)]

    def rows(self, pictures: dict[str, Tensor], batch: dict[str, Tensor]) -> list[list[Tensor]]:
        """Return one row per clip of a batch: a picture of every method, and the truth; of films, the middle one."""
        if "every" in batch:
            pictures = {method: rgb[:, rgb.shape[1] // 2] for method, rgb in pictures.items()}
            batch = middle_clip(batch)
        shown = [*pictures.values(), *([batch["rgb"]] if self.truth else [])]
        return [[rgb.clamp(0, 1).cpu() for rgb in row] for row in zip(*shown, strict=True)]

    def on_test_start(self, trainer: Trainer, module: LightningModule) -> None:  # noqa: D102
        self._scores: dict[str, list[tuple[float, ...]]] = defaultdict(list)
        self._rows: list[list[Tensor]] = []

    def on_test_batch_end(  # noqa: D102
        self, trainer: Trainer, module: LightningModule, outputs: dict[str, Any], batch: dict[str, Tensor], *_: Any
    ) -> None:
        self.truth = "rgb" in batch
        for method, scores in outputs["scores"].items():
            self._scores[method] += zip(*(scores[column].tolist() for column, _, _ in self.columns()), strict=True)
        if len(self._rows) < self.clips:
            self._rows += self.rows(outputs["pictures"], batch)[: self.clips - len(self._rows)]

    def on_test_end(self, trainer: Trainer, module: LightningModule) -> None:  # noqa: D102
        clips = len(next(iter(self._scores.values())))
        named = getattr(trainer.datamodule, "test_names", None)
        names = range(clips) if named is None else named[:clips]
        means = {
            method: torch.tensor(scores, dtype=torch.float64).mean(dim=0).tolist()
            for method, scores in self._scores.items()
        }
        with whole_file(self.output / "test.csv", "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["method", "clip", *(column for column, _, _ in self.columns())])
            for method, scores in self._scores.items():
                for n, score in zip(names, scores, strict=True):
                    writer.writerow([method, n, *map("{:.4f}".format, score)])
                writer.writerow([method, "mean", *map("{:.4f}".format, means[method])])
        write_picture(self.output / "test.png", panel(self._rows))
        missing = why_no_lpips() if any(name == "psnr" for name, *_ in self.columns()) else None
        shown = [*self._scores, *(["truth"] if self.truth else [])]
        head = [f"mean of {clips} clips", *(title for _, title, _ in self.columns())]
        places = [digits for _, _, digits in self.columns()]
        lines = [[method, *map("{:.{}f}".format, values, places)] for method, values in means.items()]
        print(f"\n{table(head, lines)}\n\n{missing or ''}")  # noqa: T201
        print(f"{self.output / 'test.csv'}, {self.output / 'test.png'} (columns: {'; '.join(shown)})")  # noqa: T201


class FlowPictures(ValidationPictures):
    """Show the first clips of every validation in TensorBoard: estimated and true flow to the last time point.

    Hue is the direction and saturation the length, on the same scale for both pictures of a clip.
    """

    title = "flow, truth"

    def rows(self, module: LightningModule, outputs: Any, batch: dict[str, Tensor]) -> list[list[Tensor]]:  # noqa: D102
        return [flow_row([flow[1]], truth[1]) for flow, truth in zip(outputs, batch["flow"], strict=True)]


class FlowReport(TestReport):
    """Print the table of a test, with all estimators on the same clips, and write ``test.csv`` and ``test.png``.

    The columns are the end-point error in sensor pixels, the share of pixels with an error above one sensor pixel,
    KITTI's outliers (errors above three pixels and 5 % of the true flow), all over both flows of a clip, and the time
    of a batch divided by its clips.
    """

    def columns(self) -> list[tuple[str, str, int]]:  # noqa: D102
        return [
            ("epe", "EPE (px)", 3),
            ("over_1px", ">1 px (%)", 2),
            ("outliers", "out (%)", 2),
            ("milliseconds", "ms/clip", 1),
        ]

    def rows(self, pictures: dict[str, Tensor], batch: dict[str, Tensor]) -> list[list[Tensor]]:  # noqa: D102
        flows = [flow[:, 1] for flow in pictures.values()]
        return [flow_row(row[:-1], row[-1]) for row in zip(*flows, batch["flow"][:, 1], strict=True)]


def flow_row(flows: list[Tensor], truth: Tensor) -> list[Tensor]:
    """Return pictures of estimated flows (2, H, W) and of the true one, all scaled by the longest true vector."""
    longest = max(truth.norm(dim=0).max().item(), 1.0)
    return [flow_to_rgb(flow.float().cpu(), longest) for flow in (*flows, truth)]

"""Callbacks for optical flow: colour-coded flow in TensorBoard and the table of a test."""

from __future__ import annotations

from typing import Any

from pytorch_lightning import LightningModule
from torch import Tensor

from lightning_modules.tasks.callbacks import TestReport, ValidationPictures
from spikekit import flow_to_rgb


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

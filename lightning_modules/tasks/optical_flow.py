"""LightningModule that trains and tests motion estimators on clips with exactly known flow."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

import torch
from pytorch_lightning.cli import LRSchedulerCallable, OptimizerCallable
from torch import Tensor, nn

from lightning_modules.motion import ClassicalFlow, Spike2Flow, ZeroFlow
from lightning_modules.tasks.base import BaseTask, step_schedule
from lightning_modules.tasks.callbacks import FlowPictures, FlowReport
from spikekit import bayer_pattern, split_bayer

_DISCOUNT = 0.8  # weight of an iteration relative to the next


# not a lambda, so that a module can be pickled
def _adamw(parameters: Iterable[nn.Parameter]) -> torch.optim.AdamW:
    return torch.optim.AdamW(parameters, lr=1e-3)


class FlowTraining(BaseTask):
    """Train Spike2Flow on clips with known flow and compare it with the estimators without weights.

    Every colour sub-stream learns its own flow. The loss is the mean absolute error of all iterations; each counts 0.8
    times as much as the next (RAFT's sequence loss). Flows to intermediate times are compared with the fractions of the
    true flow that linear motion has. Validation measures the joint flow, in sensor pixels.

    Args:
        network: the estimator.
        frames: spike frames of a clip, odd.
        window: spike frames of a time point of CSCSR, odd. The flow runs from the middle frame to the middle of the
            first and of the last window.
        pattern: Bayer phase; must match the data.
        optimizer: builds the optimiser from the parameters.
        lr_scheduler: builds the schedule from the optimiser, counted in steps.
    """

    best = ("val/epe", "min")
    pictures = FlowPictures
    report = FlowReport

    def __init__(
        self,
        network: Spike2Flow,
        frames: int = 41,
        window: int = 11,
        pattern: str = "RGGB",
        optimizer: OptimizerCallable = _adamw,
        lr_scheduler: LRSchedulerCallable = step_schedule,
    ) -> None:
        needs = {"pattern": bayer_pattern(pattern), "frames": frames}
        times = window // 2, frames // 2, frames - 1 - window // 2
        super().__init__(network, needs, times, optimizer, lr_scheduler)
        if frames % 2 == 0 or window % 2 == 0 or not 1 <= window < frames:
            raise ValueError(f"frames, window: expected odd numbers, window below frames, got {frames}, {window}")
        if not any(parameter.requires_grad for parameter in network.parameters()):
            raise ValueError("network: expected one that learns, got a frozen one")
        self.pattern = needs["pattern"]

    def forward(self, spikes: Tensor) -> Tensor:
        """Estimate the joint flows to the first and to the last time point, (B, 2, 2, H, W)."""
        return torch.stack(self.network(spikes, self.flow_times, self.pattern), dim=1)

    def training_step(self, batch: dict[str, Tensor], batch_index: int) -> Tensor:  # noqa: D102
        truth = split_bayer(batch["flow"], self.pattern) / 2  # (4, B, 2, 2, h, w) in Bayer cells
        flows = self.network.refinements(batch["spikes"], self.flow_times, self.pattern)
        shares = truth.new_tensor([1 / 3, 2 / 3, 1]).reshape(3, 1, 1, 1)
        errors = [(flow - shares * truth.unsqueeze(3)).abs().mean() for flow in flows]
        loss = sum(_DISCOUNT**age * error for age, error in enumerate(reversed(errors)))
        self.log("train/loss", loss, prog_bar=True)
        return loss

    def validation_step(self, batch: dict[str, Tensor], batch_index: int) -> Tensor:  # noqa: D102
        flow, truth = self(batch["spikes"]), batch["flow"]
        for name, estimate in (("", flow), ("_zero", torch.zeros_like(flow))):
            for measure, values in _scores(estimate, truth).items():
                self.log(f"val/{measure}{name}", values.mean(), sync_dist=True)
        return flow

    def test_step(self, batch: dict[str, Tensor], batch_index: int) -> dict[str, dict[str, Any]]:
        """Return the joint flows of all estimators, (B, 2, 2, H, W), as ``pictures`` by name, and their ``scores``."""
        flows, scores = {}, {}
        for estimator in (self.network, ClassicalFlow(), ZeroFlow()):
            start, name = time.perf_counter(), type(estimator).__name__
            flow = torch.stack(estimator(batch["spikes"], self.flow_times, self.pattern), dim=1)
            if flow.is_cuda:
                torch.cuda.synchronize(flow.device)
            milliseconds = 1000 * (time.perf_counter() - start) / len(flow)
            flows[name] = flow
            found = _scores(flow, batch["flow"])
            found |= {measure: 100 * found[measure] for measure in ("over_1px", "outliers")}  # per cent
            scores[name] = {**found, "milliseconds": flow.new_full((len(flow),), milliseconds)}
        for measure, values in scores[type(self.network).__name__].items():
            self.log(f"test/{measure}", values.mean())
        return {"pictures": flows, "scores": scores}


def _scores(flow: Tensor, truth: Tensor) -> dict[str, Tensor]:
    """Return the end-point error (Baker et al., IJCV 2011) and fractions of wrong pixels for every clip.

    Outliers are those of KITTI (Menze and Geiger, CVPR 2015): errors above three pixels and 5 % of the true flow.
    """
    error = (flow - truth).norm(dim=2)
    outliers = (error > 3) & (error > 0.05 * truth.norm(dim=2))
    measures = {"epe": error, "over_1px": error > 1, "outliers": outliers}
    return {name: values.float().flatten(1).mean(dim=1) for name, values in measures.items()}

"""The LightningModule that trains and judges super-resolution networks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Literal

import torch
from pytorch_lightning.cli import LRSchedulerCallable, OptimizerCallable
from torch import Tensor, nn

from lightning_modules.data.margin import trim
from lightning_modules.inference.clips import film_groups
from lightning_modules.inference.film import FilmMaker
from lightning_modules.inference.predict import predict
from lightning_modules.metrics.image import score
from lightning_modules.networks import ClassicalDecoder, Network, RecurrentCSCSR
from lightning_modules.networks.classical import METHODS
from lightning_modules.storage.pretrained import load_weights, read_weights, with_own_motion
from lightning_modules.tasks.base import BaseTask, step_schedule
from lightning_modules.tasks.callbacks import TestReport, ValidationPictures, middle_clip, middle_half
from spikekit import psnr, ssim


# no lambda, so that a module can be pickled
def _adam(parameters: Iterable[nn.Parameter]) -> torch.optim.Adam:
    return torch.optim.Adam(parameters, lr=1e-4)


def _loss(rgb: Tensor, batch: dict[str, Tensor]) -> Tensor:
    """L1; in clips of many gains, times the root of the gain, by which what noise leaves of it falls."""
    error = (rgb - batch["rgb"]).abs()
    if "alpha" not in batch:
        return error.mean()
    return (error.flatten(1).mean(dim=1) * batch["alpha"].sqrt()).mean()


class SuperResolution(BaseTask):
    """Train a network on clips whose truth is known, and judge it beside the classical decoders.

    Everything but training uses the network's own estimator of motion, as a recording would; ``test`` shows the result
    with the scene's flow in a row of its own. A checkpoint holds the weights of the estimator, too; those of another
    kind of estimator than this run's are passed over, and this run's stay as they were built.

    Args:
        network: the network, such as CSCSR. ``lightning`` builds it as the weights want it, where some are given.
        optimizer: builds the optimizer from the parameters; the paper uses Adam at 1e-4.
        lr_scheduler: builds the schedule from the optimizer, counted in steps; the paper multiplies by 0.8 every 7500.
        flow: the motion that training uses. "scene" is that of the data, where they have it: the true one of analytic
            scenes, or that which the frames of a film were interpolated with. "estimated" is that of the network's own
            estimator, which learns as well unless it is frozen; it sees what there is of a scene around a patch.
        frozen: parts of the network that do not learn, such as ``representation``.
        future: key frames that a picture of a film may wait for, where the network makes films.
        weights: what the network starts with: the name of weights that come with the package, such as
            ``cscsr_small_x4``, a file of safetensors, or a checkpoint of which only the weights are taken.
    """

    best = ("val/psnr", "max")
    pictures = ValidationPictures
    report = TestReport

    def __init__(
        self,
        network: Network,
        optimizer: OptimizerCallable = _adam,
        lr_scheduler: LRSchedulerCallable = step_schedule,
        flow: Literal["scene", "estimated"] = "scene",
        frozen: Sequence[str] = (),
        future: int = 0,
        weights: str | None = None,
    ) -> None:
        super().__init__(network, {"pattern": network.pattern}, network.flow_times, optimizer, lr_scheduler)
        if flow not in ("scene", "estimated"):
            raise ValueError(f"flow: expected 'scene' or 'estimated', got {flow!r}")
        fusion = network.settings.get("motion_fusion", "joint")
        if flow == "scene" and fusion != "joint":
            raise ValueError(
                f"flow: expected 'estimated' with motion_fusion {fusion!r}, the scene's is one for all colours"
            )
        FilmMaker(network, future)  # what is wrong with it is said at once
        self.flow, self.future = flow, future
        self._told = ["alpha", "noise"] if network.settings.get("noise") else ["alpha"]  # what it hears of the camera
        parts = dict(network.named_modules())
        for name in frozen:
            if name not in parts:
                known = ", ".join(name for name, _ in network.named_children())
                raise ValueError(f"frozen: expected parts of the network, such as {known}, got {name}")
            parts[name].requires_grad_(False)
        if weights is not None:
            load_weights(network, read_weights(weights))

    def forward(self, spikes: Tensor, flow: Tensor | None = None) -> Tensor:
        """Return the picture of the middle of a clip, tile by tile: (B, N, H, W) to (B, 3, s H, s W), in [0, 1].

        The motion is ``flow``, (B, 2, 2, H, W), or else what the network's estimator sees.
        """
        return predict(self.network, spikes, flow)

    def training_step(self, batch: dict[str, Tensor], batch_index: int) -> Tensor:  # noqa: D102
        batch, flow = self._with_motion(batch)
        pictures = self._pictures(batch, flow)
        loss = sum(_loss(rgb, batch) for rgb in pictures) / len(pictures)
        self.log("train/loss", loss)
        self.log("train/psnr", psnr(pictures[-1].detach(), batch["rgb"]).mean(), prog_bar=True)
        return loss

    def _with_motion(self, batch: dict[str, Tensor]) -> tuple[dict[str, Tensor], Tensor | None]:
        """Clips of patches, and the motion in them: what is around them serves its estimate alone."""
        spikes, flow = batch["spikes"], batch.get("flow" if self.flow == "scene" else "motion")
        margin = (spikes.shape[-1] - batch["rgb"].shape[-1] // self.network.scale) // 2
        if not margin:
            return batch, flow
        if flow is None and self.network.takes_flow and not self.network.motion.static:
            seen = self.network.estimate_flow(spikes.flatten(0, -4))
            flow = trim(seen, margin).unflatten(0, spikes.shape[:-3])
        return {**batch, "spikes": trim(spikes, margin)}, flow

    def _pictures(self, batch: dict[str, Tensor], flow: Tensor | None = None) -> list[Tensor]:
        """Pictures of clips; of films after every time that they were read.

        A film that was read from its end is the mirror image of one that is read but once: both learn.
        """
        spikes = batch["spikes"]
        told = {name: batch[name] for name in self._told if name in batch}
        if "every" not in batch:
            return [self.network(spikes, flow, **told)]
        if isinstance(self.network, RecurrentCSCSR):
            return self.network.film(spikes, flow, every=int(batch["every"][0]), future=self.future, **told)
        flow = None if flow is None else flow.flatten(0, 1)
        told = {name: value.repeat_interleave(spikes.shape[1]) for name, value in told.items()}
        return [self.network(spikes.flatten(0, 1), flow, **told).unflatten(0, spikes.shape[:2])]

    def validation_step(self, batch: dict[str, Tensor], batch_index: int) -> Tensor:  # noqa: D102
        rgb = self._pictures(batch)[-1]
        if "every" in batch:  # of a film, the key frame in the middle stands for all
            rgb, batch = rgb[:, rgb.shape[1] // 2], middle_clip(batch)
        self.log("val/psnr", psnr(rgb, batch["rgb"]).mean(), prog_bar=True, sync_dist=True)
        self.log("val/ssim", ssim(rgb, batch["rgb"]).mean(), sync_dist=True)
        return rgb.clamp(0, 1)

    def test_step(self, batch: dict[str, Tensor], batch_index: int) -> dict[str, dict[str, Any]]:
        """Return ``pictures`` by method, of a film those that are judged, (B, K, 3, s H, s W), and their ``scores``."""
        spikes, settings = batch["spikes"], self.network.settings
        name, decoder = type(self.network).__name__, (settings["scale"], settings["pattern"], settings["alpha"])
        film = "every" in batch
        clips, truth = spikes, batch["rgb"]
        if film:
            judged = middle_half(batch)
            clips, truth = spikes[:, judged].flatten(0, 1), truth[:, judged]
        pictures = {method.upper(): ClassicalDecoder(method, *decoder)(clips) for method in METHODS}
        pictures[f"{name}, single clips" if film else name] = self(clips)
        if film:
            pictures = {method: rgb.unflatten(0, truth.shape[:2]) for method, rgb in pictures.items()}
            if isinstance(self.network, RecurrentCSCSR):
                films = [self._film(clip, int(batch["every"][0])) for clip in spikes]
                pictures[f"{name}, film"] = torch.stack(films)[:, judged]
        own = list(pictures)[-1]
        if "flow" in batch and self.network.takes_flow and not film:
            pictures[f"{name}, true flow"] = self(spikes, batch["flow"])
        scores = {method: score(rgb, truth) for method, rgb in pictures.items()}
        for measure, values in scores[own].items():
            self.log(f"test/{measure}", values.mean())
        return {"pictures": pictures, "scores": scores}

    def _film(self, clips: Tensor, every: int) -> Tensor:
        """Pictures (K, 3, s H, s W) of clips (K, N, H, W), every so many clocks."""
        maker, groups = FilmMaker(self.network, self.future), film_groups(range(len(clips)), self.future)
        return torch.cat([maker(clips[group], [every * n for n in group]) for group in groups])

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:  # noqa: D102
        super().on_load_checkpoint(checkpoint)
        checkpoint["state_dict"] = with_own_motion(checkpoint["state_dict"], self.network.motion, "network.")

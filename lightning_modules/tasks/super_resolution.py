"""LightningModule that trains and tests super-resolution networks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Literal

import torch
from pytorch_lightning.cli import LRSchedulerCallable, OptimizerCallable
from torch import Tensor, nn

from lightning_modules.data.loading import trim
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


# not a lambda, so that a module can be pickled
def _adam(parameters: Iterable[nn.Parameter]) -> torch.optim.Adam:
    return torch.optim.Adam(parameters, lr=1e-4)


def _loss(rgb: Tensor, batch: dict[str, Tensor]) -> Tensor:
    """L1 loss; for clips of different gains, weighted by the root of the gain, as noise falls with it."""
    error = (rgb - batch["rgb"]).abs()
    if "alpha" not in batch:
        return error.mean()
    return (error.flatten(1).mean(dim=1) * batch["alpha"].sqrt()).mean()


class SuperResolution(BaseTask):
    """Train a network on clips with ground truth and compare it with the classical decoders.

    Validation and prediction use the network's own motion estimator, as recordings need; ``test`` also has a row with
    the flow of the scene. A checkpoint includes the weights of the estimator; they are ignored if this run has another
    kind of estimator.

    Args:
        network: the network, such as CSCSR. With ``weights``, ``lightning`` builds it from their settings.
        optimizer: builds the optimiser from the parameters; the paper uses Adam at 1e-4.
        lr_scheduler: builds the schedule from the optimiser, counted in steps; the paper multiplies by 0.8 every 7500.
        flow: source of the motion in training. "scene" is the flow of the data, if they have one: the true flow of
            analytic scenes, or the flow that a film was interpolated with. "estimated" is the estimate of the network's
            own estimator, which is trained as well unless it is frozen; it also sees the surroundings of a patch.
        frozen: names of submodules that are not trained, such as ``representation``.
        future: later key frames that a picture of a film may wait for; only for networks for films.
        weights: initial weights: a name of the package such as ``cscsr_small_x4``, a safetensors file, or a checkpoint,
            of which only the weights are used.
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
                f"flow: expected 'estimated' with motion_fusion {fusion!r}, as the scene has one flow for all colours"
            )
        FilmMaker(network, future)  # reports a wrong ``future`` at once
        self.flow, self.future = flow, future
        self._told = ["alpha", "noise"] if network.settings.get("noise") else ["alpha"]  # inputs about the camera
        parts = dict(network.named_modules())
        for name in frozen:
            if name not in parts:
                known = ", ".join(name for name, _ in network.named_children())
                raise ValueError(f"frozen: expected parts of the network, such as {known}, got {name}")
            parts[name].requires_grad_(False)
        if weights is not None:
            load_weights(network, read_weights(weights))

    def forward(self, spikes: Tensor, flow: Tensor | None = None) -> Tensor:
        """Return the picture at the middle of a clip, tile by tile: (B, N, H, W) to (B, 3, s H, s W), in [0, 1].

        ``flow`` is (B, 2, 2, H, W); default: the estimate of the network.
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
        """Return a batch without margins, and its flow; margins around patches only serve motion estimation."""
        spikes, flow = batch["spikes"], batch.get("flow" if self.flow == "scene" else "motion")
        margin = (spikes.shape[-1] - batch["rgb"].shape[-1] // self.network.scale) // 2
        if not margin:
            return batch, flow
        if flow is None and self.network.takes_flow and not self.network.motion.static:
            seen = self.network.estimate_flow(spikes.flatten(0, -4))
            flow = trim(seen, margin).unflatten(0, spikes.shape[:-3])
        return {**batch, "spikes": trim(spikes, margin)}, flow

    def _pictures(self, batch: dict[str, Tensor], flow: Tensor | None = None) -> list[Tensor]:
        """Return the pictures of clips; of films, one result per pass, forwards and backwards, as both are trained."""
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
        if "every" in batch:  # the middle key frame represents a film
            rgb, batch = rgb[:, rgb.shape[1] // 2], middle_clip(batch)
        self.log("val/psnr", psnr(rgb, batch["rgb"]).mean(), prog_bar=True, sync_dist=True)
        self.log("val/ssim", ssim(rgb, batch["rgb"]).mean(), sync_dist=True)
        return rgb.clamp(0, 1)

    def test_step(self, batch: dict[str, Tensor], batch_index: int) -> dict[str, dict[str, Any]]:
        """Return ``pictures`` by method, of a film the scored ones, (B, K, 3, s H, s W), and their ``scores``."""
        spikes, settings = batch["spikes"], self.network.settings
        white = batch["white"].item() if "white" in batch else settings["alpha"]  # recordings have their own
        name, decoder = type(self.network).__name__, (settings["scale"], settings["pattern"], white)
        film = "every" in batch
        if "noise" in batch:  # one level for all test clips
            self.network.noise_level = batch["noise"].flatten()[0].item()
        clips, truth = spikes, batch.get("rgb")
        if film:
            judged = middle_half(batch)
            clips, truth = spikes[:, judged].flatten(0, 1), truth[:, judged]
        pictures = {method.upper(): ClassicalDecoder(method, *decoder)(clips) for method in METHODS}
        exposed = predict(self.network, clips, exposure=settings["alpha"] / white)
        pictures[f"{name}, single clips" if film else name] = exposed
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
        """Return the pictures (K, 3, s H, s W) of clips (K, N, H, W) that are ``every`` clocks apart."""
        size = self.future + 1
        maker, groups = FilmMaker(self.network, self.future), film_groups(range(len(clips)), size, size)
        return torch.cat([maker(clips[group], [every * n for n in group]) for group in groups])

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:  # noqa: D102
        super().on_load_checkpoint(checkpoint)
        checkpoint["state_dict"] = with_own_motion(checkpoint["state_dict"], self.network.motion, "network.")

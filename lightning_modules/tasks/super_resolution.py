"""The LightningModule that trains and judges super-resolution networks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal, Self

import torch
import torch.nn.functional as F
from pytorch_lightning.cli import LRSchedulerCallable, OptimizerCallable
from torch import Tensor, nn

from lightning_modules.data.margin import trim
from lightning_modules.inference.clips import film_groups
from lightning_modules.inference.film import FilmMaker
from lightning_modules.inference.predict import predict
from lightning_modules.inference.presets import Preset, choose
from lightning_modules.inference.self_ensemble import COUNTS
from lightning_modules.inference.tiles import TILE
from lightning_modules.networks import ClassicalDecoder, Network, RecurrentCSCSR
from lightning_modules.storage.pretrained import load_weights, read_weights, with_own_motion
from lightning_modules.tasks.base import BaseTask, step_schedule
from lightning_modules.tasks.callbacks import TestReport, ValidationPictures, middle_clip, middle_half
from spikekit import psnr, ssim
from spikekit.decoders.methods import DECODERS

_NO_ERROR = 1e-4  # mean absolute error of a clip below which there is little to gain


# no lambda, so that a module can be pickled
def _adam(parameters: Iterable[nn.Parameter]) -> torch.optim.Adam:
    return torch.optim.Adam(parameters, lr=1e-4)


def _loss(rgb: Tensor, batch: dict[str, Tensor]) -> Tensor:
    """Mean absolute error; for many gains its logarithm, clip by clip, so that little light does not outweigh much."""
    if "alpha" not in batch:
        return F.l1_loss(rgb, batch["rgb"])
    return ((rgb - batch["rgb"]).abs().flatten(1).mean(dim=1) + _NO_ERROR).log().mean()


class SuperResolution(BaseTask):
    """Train a network on clips whose truth is known, judge it beside the classical decoders, run it on recordings.

    Everything but training uses the network's own estimator of motion, as a recording would; ``test`` shows the result
    with the scene's flow in a row of its own. A checkpoint holds the weights of the estimator, too; those of another
    kind of estimator than this run's are passed over, and this run's stay as they were built.

    Args:
        network: the network, such as CSCSR. ``lightning`` builds it as the weights want it, where some are given.
        optimizer: builds the optimizer from the parameters; the paper uses Adam at 1e-4.
        lr_scheduler: builds the schedule from the optimizer, counted in steps; the paper multiplies by 0.8 every 7500.
        tile: side of the tiles, in sensor pixels, in which ``predict`` and ``test`` work through large views; 0 for
            none.
        psnr_tolerance: by how many dB the PSNR of a picture may be expected to fall when ``predict`` and ``test`` look
            at the clip first and do only what each part of it needs; 0 for everything everywhere.
        self_ensemble: 2, 4 or 8 lets ``predict`` and ``test`` give the mean picture of so many views of a
            clip, transposed, turned and mirrored, in so many times the time.
        flow: the motion that training uses. "scene" is that of the data, where they have it: the true one of analytic
            scenes, or that which the frames of a film were interpolated with. "estimated" is that of the network's own
            estimator, which learns as well unless it is frozen; it sees what there is of a scene around a patch.
        frozen: parts of the network that do not learn, such as ``representation``.
        future: key frames that a picture of a film may wait for, where the network makes films.
        interpolated: pictures of a film between two that the network makes; these are moved there along the motion.
        weights: what the network starts with: the name of weights that come with the package, such as
            ``cscsr_small_x4``, a file of safetensors, or a checkpoint of which only the weights are taken.
        tolerance: old name of ``psnr_tolerance``.
    """

    best = ("val/psnr", "max")
    pictures = ValidationPictures
    report = TestReport

    def __init__(
        self,
        network: Network,
        optimizer: OptimizerCallable = _adam,
        lr_scheduler: LRSchedulerCallable = step_schedule,
        tile: int = TILE,
        psnr_tolerance: float = 0.0,
        self_ensemble: Literal[1, 2, 4, 8] = 1,
        flow: Literal["scene", "estimated"] = "scene",
        frozen: Sequence[str] = (),
        future: int = 0,
        interpolated: int = 0,
        weights: str | None = None,
        tolerance: float | None = None,
    ) -> None:
        super().__init__(network, {"pattern": network.pattern}, network.flow_times, optimizer, lr_scheduler)
        if tile < 0 or tile % 2:
            raise ValueError(f"tile: expected an even number of sensor pixels, or 0 for no tiles, got {tile}")
        if tolerance is not None:
            if psnr_tolerance not in (0, tolerance):
                raise ValueError(
                    "tolerance: expected psnr_tolerance alone, of which it is the old name, "
                    f"got {tolerance} and {psnr_tolerance}"
                )
            psnr_tolerance = tolerance
        if not 0 <= psnr_tolerance < math.inf:
            raise ValueError(f"psnr_tolerance: expected 0 dB or more, got {psnr_tolerance}")
        if flow not in ("scene", "estimated"):
            raise ValueError(f"flow: expected 'scene' or 'estimated', got {flow!r}")
        if isinstance(self_ensemble, bool) or self_ensemble not in COUNTS:
            raise ValueError(f"self_ensemble: expected one of {COUNTS}, got {self_ensemble!r}")
        fusion = network.settings.get("motion_fusion", "joint")
        if flow == "scene" and fusion != "joint":
            raise ValueError(
                f"flow: expected 'estimated' with motion_fusion {fusion!r}, the scene's is one for all colours"
            )
        self.tile = tile
        self.psnr_tolerance = psnr_tolerance
        self.self_ensemble = self_ensemble
        self.flow = flow
        self.future, self.interpolated = future, interpolated
        FilmMaker(network, future, interpolated, **self._how)  # what is wrong with them is said at once
        self._told = ["alpha", "noise"] if network.settings.get("noise") else ["alpha"]  # what it hears of the camera
        parts = dict(network.named_modules())
        for name in frozen:
            if name not in parts:
                known = ", ".join(name for name, _ in network.named_children())
                raise ValueError(f"frozen: expected parts of the network, such as {known}, got {name}")
            parts[name].requires_grad_(False)
        if weights is not None:
            load_weights(network, read_weights(weights))

    @classmethod
    def from_pretrained(
        cls,
        scale: int = 4,
        speed: str | None = None,
        budget: str | None = None,
        size: tuple[int, int] = (250, 400),
    ) -> Self:
        """Build what ``lightning predict --speed`` or ``--budget`` would, from the weights of the package.

        Args:
            scale: super-resolution factor.
            speed: see :func:`lightning_modules.inference.presets.choose`; ``"balanced"`` when neither it nor a budget
                is given.
            budget: likewise.
            size: of a frame, (H, W) in sensor pixels, which a budget depends on.

        Returns:
            The module in evaluation mode; called with spikes it returns pictures.

        Raises:
            ValueError: an unknown speed, a budget that nothing fits, a scale without weights.

        Example:
            >>> SuperResolution.from_pretrained(speed="fastest")(torch.ones(1, 41, 16, 16)).shape
            torch.Size([1, 3, 64, 64])
        """
        if isinstance(scale, str):
            raise ValueError(
                f"scale: expected a number, got {scale!r}; for weights by their name, CSCSR.from_pretrained({scale!r})"
            )
        if budget is None and speed is None:
            speed = "balanced"
        return cls.from_preset(choose(scale, speed, budget, size).preset)

    @classmethod
    def from_preset(cls, preset: Preset) -> Self:
        """Build what a preset says, in evaluation mode.

        Args:
            preset: without a precision, which a Trainer sets.

        Raises:
            FileNotFoundError: there are no such weights.
            ValueError: a preset with a precision, or one that cannot be built.

        Example:
            >>> SuperResolution.from_preset(Preset("cscsr_small_x4", self_ensemble=2)).self_ensemble
            2
        """
        if preset.precision is not None:
            raise ValueError(f"precision: expected none, as a Trainer sets it, got {preset.precision!r}")
        return cls(preset.build(), **preset.given("tile", "psnr_tolerance", "self_ensemble", "interpolated")).eval()

    def forward(
        self, spikes: Tensor, flow: Tensor | None = None, static: bool = False, exposure: float | Tensor = 1.0
    ) -> Tensor:
        """Return the picture of the middle of a clip, tile by tile: (B, N, H, W) to (B, 3, s H, s W), in [0, 1].

        The motion is ``flow``, (B, 2, 2, H, W), none with ``static``, or else what the network's estimator sees. The
        picture is multiplied by ``exposure``.
        """
        return predict(self.network, spikes, flow, static, exposure=exposure, **self._how)

    @property
    def _how(self) -> dict[str, Any]:
        return {"tile": self.tile, "psnr_tolerance": self.psnr_tolerance, "self_ensemble": self.self_ensemble}

    def training_step(self, batch: dict[str, Tensor], batch_index: int) -> Tensor:  # noqa: D102
        batch, flow = self._with_motion(batch)
        pictures = self._pictures(batch, flow)
        loss = sum(_loss(rgb, batch) for rgb in pictures) / len(pictures)
        self.log("train/loss", loss)
        self.log("train/psnr", psnr(pictures[-1].detach(), batch["rgb"]).mean(), prog_bar=True)
        return loss

    def _with_motion(self, batch: dict[str, Tensor]) -> tuple[dict[str, Tensor], Tensor | None]:
        """Clips of patches, and the motion in them: what is around them serves its estimate alone."""
        spikes, flow = batch["spikes"], batch.get("flow") if self.flow == "scene" else None
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
        self.log_mean("val/psnr", psnr(rgb, batch["rgb"]), prog_bar=True)
        self.log_mean("val/ssim", ssim(rgb, batch["rgb"]))
        return rgb.clamp(0, 1)

    def test_step(self, batch: dict[str, Tensor], batch_index: int) -> dict[str, Tensor]:
        """Return the picture of every method, by name; of a film those that are judged, (B, K, 3, s H, s W)."""
        spikes, settings = batch["spikes"], self.network.settings
        name = type(self.network).__name__
        shared = settings["scale"], settings["pattern"], settings["alpha"]
        if "every" in batch:
            judged = middle_half(batch)
            clips = spikes[:, judged]
            alone = self._of_clips(clips.flatten(0, 1), shared) | {f"{name}, single clips": self(clips.flatten(0, 1))}
            pictures = {method: rgb.unflatten(0, clips.shape[:2]) for method, rgb in alone.items()}
            if self._makes_films:
                films = [self._film(clip, int(batch["every"][0])) for clip in spikes]
                pictures[f"{name}, film"] = torch.stack(films)[:, judged]
            return pictures
        pictures = self._of_clips(spikes, shared) | {name: self(spikes)}
        if "flow" in batch and self.network.takes_flow:
            pictures[f"{name}, true flow"] = self(spikes, batch["flow"])
        return pictures

    def _of_clips(self, spikes: Tensor, shared: tuple[int, str, float]) -> dict[str, Tensor]:
        return {method.upper(): ClassicalDecoder(method, *shared)(spikes) for method in DECODERS}

    @property
    def _makes_films(self) -> bool:
        return isinstance(self.network, RecurrentCSCSR) or self.interpolated > 0

    def _film(self, clips: Tensor, every: int) -> Tensor:
        """Pictures (K, 3, s H, s W) of clips (K, N, H, W), every so many clocks."""
        pictures = FilmMaker(self.network, self.future, self.interpolated, **self._how)
        groups = film_groups(range(len(clips)), self.future, self.interpolated)
        return torch.cat([pictures(clips[group], [every * n for n in group]) for group in groups])

    def predict_step(self, batch: dict[str, Tensor], batch_index: int) -> Tensor:
        """Return rgb (B, 3, s H, s W), clamped to [0, 1]; a rate of ``white``, where it is known, is 1, else alpha."""
        exposure = self.network.settings["alpha"] / batch["white"][:, None, None, None] if "white" in batch else 1.0
        return self(batch["spikes"], exposure=exposure)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:  # noqa: D102
        super().on_load_checkpoint(checkpoint)
        checkpoint["state_dict"] = with_own_motion(checkpoint["state_dict"], self.network.motion, "network.")

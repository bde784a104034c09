"""What the rest of the house knows of a super-resolution network."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn

from lightning_modules import motion as estimators
from lightning_modules.motion import ClassicalFlow, MotionEstimator
from lightning_modules.pretrained import load_weights, read_weights


class Network(nn.Module):
    r"""Base of the networks that map a clip of spikes to the colour picture of its middle frame.

    Args:
        settings: what the constructor was given, as plain values, with at least ``scale``, ``frames``, ``pattern``
            and ``alpha``; a checkpoint remembers them, because they are not all to be seen in its weights.
        flow_times: spike frames that the flows run between: the first, the middle and the last time point.
        motion: estimator that is asked where no flow is given; :class:`lightning_modules.motion.ClassicalFlow` when
            not given.

    Shape:
        - Input: spikes :math:`(B, N, H, W)`; optionally flow :math:`(B, 2, 2, H, W)`, from the middle to the first
          and to the last time point, in sensor pixels, or 0 where nothing moves
        - Output: rgb :math:`(B, 3, s H, s W)`, not clamped
    """

    def __init__(
        self, settings: dict[str, Any], flow_times: tuple[int, int, int], motion: MotionEstimator | None = None
    ) -> None:
        super().__init__()
        self.settings = settings
        self.scale: int = settings["scale"]
        self.frames: int = settings["frames"]
        self.pattern: str = settings["pattern"]
        self.flow_times = flow_times
        self.motion = ClassicalFlow() if motion is None else motion

    @classmethod
    def from_pretrained(cls, weights: str | Path, motion: MotionEstimator | None = None) -> Self:
        """Build the network that weights are of, and load them.

        Args:
            weights: the name of weights that come with the package, such as ``"x4-e"``; a file of safetensors; or a
                checkpoint of ``lightning fit``.
            motion: estimator that is asked where no flow is given; when not given, the one inside the weights, or
                :class:`lightning_modules.motion.ClassicalFlow` where none is.

        Returns:
            The network, in evaluation mode, on the CPU.

        Raises:
            FileNotFoundError: neither a file nor the name of one; the message says which names there are.
            ValueError: a file that is damaged, or of another kind of network.
        """
        found = read_weights(weights)
        settings, inside = dict(found.settings), dict(found.motion)
        kind = settings.pop("class", None)
        if kind != cls.__name__:
            raise ValueError(f"{weights}: expected weights of {cls.__name__}, got those of {kind}")
        own = motion is not None
        try:
            if inside and not own:
                motion = getattr(estimators, inside.pop("class"))(**inside)
            network = cls(**settings, motion=motion)
        except (AttributeError, KeyError, TypeError) as error:
            raise ValueError(f"{weights}: written by another version of this package ({error})") from error
        load_weights(network, found, keep_motion=own)
        return network.eval()

    def estimate_flow(self, spikes: Tensor) -> Tensor:
        """Flows from the middle to the first and to the last time point, (B, 2, 2, H, W), in sensor pixels."""
        return torch.stack(self.motion(spikes, self.flow_times, self.pattern), dim=1)

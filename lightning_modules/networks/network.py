"""Base class of the super-resolution networks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from inspect import signature
from operator import eq
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.compiler import is_exporting

from lightning_modules.motion import ESTIMATORS, ClassicalFlow, MotionEstimator
from lightning_modules.storage.pretrained import check_weights, load_weights, read_weights
from lightning_modules.storage.settings import own_class
from spikekit.check import check_planes

#: settings that every network has
_ALL_HAVE = "scale", "frames", "pattern", "alpha"


class Network(nn.Module):
    r"""Base class of networks that map a clip of spike frames to the picture at its middle.

    A subclass calls ``super().__init__()`` and stores its arguments as attributes of the same names. Its ``forward``
    takes spikes and flow; flow is None by default, and :meth:`estimate_flow` computes it. Training, testing and
    loading then work through the name of the class. Such a network runs on whole pictures, without tiles.

    Args:
        settings: arguments of the constructor as plain values, with at least ``scale``, ``frames``, ``pattern`` and
            ``alpha``. Checkpoints store them to build the network again. Default: those four, and the attributes
            named like the constructor's arguments.
        flow_times: spike frames between which the flows run: the first, middle and last time points. Default: the
            centres of windows of 11 frames.
        motion: motion estimator, called when no flow is given. Default:
            :class:`lightning_modules.motion.ClassicalFlow`.

    Attributes:
        halo: radius of the receptive field in sensor pixels, without the reach of motion; even, to keep the Bayer
            phase. None if it covers the whole picture or is unknown: such a network does not run in tiles. Shipped
            weights define their own.
        takes_flow: whether the flow affects the result.
        joins: whether spike frames are joined in dim light; if not, clips only become longer.
        noise_level: default noise level, 0 for an ideal sensor and 1 for the sensor used in training. Networks
            trained without noise levels ignore it.
        warm_up: number of earlier key frames that visibly affect a picture of a film; 0 for independent clips.
        flow_groups: accepted dimensions of the flow between the batch and ``(2, 2, H, W)``.

    Shape:
        - Input: spikes :math:`(B, N, H, W)`; optionally flow :math:`(B, 2, 2, H, W)`, from the middle to the first
          and last time points, in sensor pixels; or ``static=True`` for a scene without motion
        - Output: rgb :math:`(B, 3, s H, s W)`, not clamped
    """

    scale: int = 4
    frames: int = 41
    pattern: str = "RGGB"
    alpha: float = 0.4
    halo: int | None = None
    takes_flow: bool = True
    joins: bool = True
    noise_level: float = 0.0
    warm_up: int = 0
    flow_groups: tuple[tuple[int, ...], ...] = ((),)

    def __init__(
        self,
        settings: dict[str, Any] | None = None,
        flow_times: tuple[int, int, int] | None = None,
        motion: MotionEstimator | None = None,
    ) -> None:
        super().__init__()
        self._settings, self._flow_times = settings, flow_times
        for name in _ALL_HAVE if settings else ():
            setattr(self, name, settings[name])
        self.motion = ClassicalFlow() if motion is None else motion

    @property
    def settings(self) -> dict[str, Any]:
        """Arguments of the constructor, by name, as plain values."""
        if self._settings is not None:
            return self._settings
        names = dict.fromkeys((*_ALL_HAVE, *signature(type(self)).parameters))
        return {name: getattr(self, name) for name in names if hasattr(self, name) and name != "motion"}

    @property
    def flow_times(self) -> tuple[int, int, int]:
        """Spike frames between which the flows run: the first, middle and last time points."""
        return self._flow_times or (5, self.frames // 2, self.frames - 6)

    @classmethod
    def from_pretrained(cls, weights: str | Path, motion: MotionEstimator | None = None, **arguments: Any) -> Self:
        """Build the network of a weights file, of this class or a subclass, and load its weights.

        Args:
            weights: name of weights in the package, such as ``"cscsr_small_x4"``; path of a safetensors file; or
                checkpoint of ``lightning fit``.
            motion: motion estimator, called when no flow is given. Default: the estimator in the weights file, or
                :class:`lightning_modules.motion.ClassicalFlow`.
            arguments: constructor options that may differ from those of the weights, such as ``alpha``. Default:
                those stored with the weights.

        Returns:
            The network, in evaluation mode, on the CPU.

        Raises:
            FileNotFoundError: ``weights`` is neither a file nor a known name; the message lists the names.
            ValueError: the file is damaged or holds another class of network, or ``motion`` is given for a network
                that takes no flow.
        """
        found = read_weights(weights)
        named = found.settings.get("class")
        kind = next((kind for kind in _family(cls) if kind.__name__ == named), None)
        if kind is None:
            raise ValueError(f"{weights}: expected weights of {cls.__name__}, got those of {named}")
        takes = signature(kind).parameters
        # constructors of user-defined networks need not take all common settings
        missing = set() if _ours(kind) else {*_ALL_HAVE} - takes.keys()
        settings = {name: value for name, value in found.settings.items() if name not in missing}
        check_weights(replace(found, settings=settings), {named: kind, **ESTIMATORS})
        settings.pop("class")
        own = motion is not None
        same = own and type(motion).__name__ == found.motion.get("class") and found.motion["class"] not in ESTIMATORS
        if own and not kind.takes_flow:
            raise ValueError(f"motion: expected None, as {named} takes no flow, got {type(motion).__name__}")
        try:
            if found.motion and not own:
                estimator, built_with = own_class(found.motion, weights, ESTIMATORS)
                motion = estimator(**built_with)
            flow = {"motion": motion} if kind.takes_flow and "motion" in takes else {}
            network = kind(**{**settings, **arguments}, **flow)
        except TypeError as error:
            raise ValueError(f"{weights}: written by another version of this package ({error})") from error
        load_weights(network, found, keep_motion=own and not same)
        return network.eval()

    def scale_picture(self, factor: float) -> None:
        """Scale the output by a factor, in the weights, to adapt them to another gain.

        With twice the gain, the same spikes come from a scene half as bright. Networks that divide their input by
        alpha adapt already; others override this method.
        """

    def check_spikes(self, spikes: Tensor) -> None:
        """Check that spikes are valid input of the network.

        Raises:
            TypeError: ``spikes`` is not a tensor of real numbers.
            ValueError: the number of spike frames is wrong, or there are fewer than 3 x 3 pixels.
        """
        check_planes("spikes", spikes, 4, "(B, N, H, W)")
        if spikes.ndim != 4 or spikes.shape[1] != self.frames or min(spikes.shape[-2:]) < 3:
            expected = f"(B, {self.frames}, H, W) of at least 3 x 3 pixels"
            raise ValueError(f"spikes: expected {expected}, got {tuple(spikes.shape)}")

    def estimate_flow(self, spikes: Tensor) -> Tensor:
        """Estimate the flows from the middle to the first and last time points, (B, 2, 2, H, W), in sensor pixels."""
        return torch.stack(self.motion(spikes, self.flow_times, self.pattern), dim=1)

    def resolve_flow(self, spikes: Tensor, flow: Tensor | None, static: bool) -> Tensor | None:
        """Return the given flow, or the network's own estimate, or None for a scene without motion.

        Raises:
            ValueError: the flow has a wrong shape, or is given together with ``static``.
            RuntimeError: ``torch.jit.trace`` would record the motion of its example input.
        """
        if static and flow is not None:
            raise ValueError("flow, static: expected a flow or static=True, got both")
        if static or (flow is None and self.motion.static):
            return None
        if torch.jit.is_tracing():  # False in torch.compile and torch.export
            raise RuntimeError(
                "torch.jit.trace: expected static=True or ZeroFlow, as the motion of the example input would become "
                "a constant; use torch.compile instead"
            )
        if flow is None and is_exporting():
            raise ValueError("flow: expected a tensor, as motion estimation cannot be exported, got None")
        if flow is None:
            flow = self.estimate_flow(spikes)
        shapes = [(len(spikes), *groups, 2, 2, *spikes.shape[-2:]) for groups in self.flow_groups]
        # compared element by element: list membership fails in the compiler if one side of the picture is symbolic
        same = (flow.ndim == len(shape) and all(map(eq, flow.shape, shape)) for shape in shapes)
        if not isinstance(flow, Tensor) or not any(same):
            got = tuple(flow.shape) if isinstance(flow, Tensor) else f"{flow!r}; for no motion, pass static=True"
            raise ValueError(f"flow: expected {' or '.join(map(str, shapes))}, got {got}")
        return flow


def _family(kind: type[Network]) -> Iterator[type[Network]]:
    """Yield a class and its subclasses in this package; weights files may name no other classes."""
    yield kind
    for child in kind.__subclasses__():
        if _ours(child):
            yield from _family(child)


def _ours(kind: type[Network]) -> bool:
    return kind.__module__.startswith(f"{__package__}.")


def read_network(weights: str | Path) -> nn.Module:
    """Load the network or motion estimator of a weights file, in training mode."""
    found = read_weights(weights)
    if found.settings.get("class") not in ESTIMATORS:
        return Network.from_pretrained(weights).train()
    kind, arguments = own_class(found.settings, found.source, ESTIMATORS)
    estimator = kind(**arguments)
    load_weights(estimator, found)
    return estimator

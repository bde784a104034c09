"""Base class of the super-resolution networks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from inspect import signature
from operator import eq
from pathlib import Path
from typing import Any, Self

import torch
from kornia.core.utils import is_exporting
from torch import Tensor, nn

from lightning_modules.motion import ESTIMATORS, ClassicalFlow, MotionEstimator
from lightning_modules.storage.error_model import ErrorModel
from lightning_modules.storage.pretrained import check_weights, load_weights, read_weights
from lightning_modules.storage.settings import own_class
from spikekit.check import check_planes

#: settings of all networks
_ALL_HAVE = "scale", "frames", "pattern", "alpha"


class Network(nn.Module):
    r"""Base of the networks that map a clip of spikes to the colour picture of its middle frame.

    A network of your own calls ``super().__init__()`` and keeps its arguments as attributes of the same names; its
    ``forward`` takes spikes and flow, which is None where nobody gives it: :meth:`estimate_flow` is there to ask. It is
    then trained, tested and read again by its class, whole pictures at a time.

    Args:
        settings: what the constructor was given, as plain values, with at least ``scale``, ``frames``, ``pattern``
            and ``alpha``; a checkpoint remembers them, because they are not all to be seen in its weights. When not
            given, the attributes that are called as the constructor's arguments, and those four.
        flow_times: spike frames that the flows run between: the first, the middle and the last time point. When not
            given, those of windows of 11 frames.
        motion: estimator that is asked where no flow is given; :class:`lightning_modules.motion.ClassicalFlow` when
            not given.

    Attributes:
        halo: how many sensor pixels around a place the network sees, beside those that motion reaches over; even, as
            the Bayer phase is kept. None where it sees the whole picture, or where nobody knows: such a network is
            not run in tiles. Shipped weights bring their own.
        takes_flow: whether a flow changes anything.
        error_model: what less work costs it, for a tolerance; that of the weights, once they are loaded.
        noise_level: of the sensor, where a call does not say: 0 for an ideal one, 1 for that of training. Networks that
            were not trained to be told it do not ask.
        warm_up: how many key frames before a picture of a film it depends on, as far as one can see; 0 where every
            clip stands for itself.
        flow_groups: leading dimensions of the flows that the network takes, behind the batch.

    Shape:
        - Input: spikes :math:`(B, N, H, W)`; optionally flow :math:`(B, 2, 2, H, W)`, from the middle to the first
          and to the last time point, in sensor pixels; or ``static=True`` where nothing moves
        - Output: rgb :math:`(B, 3, s H, s W)`, not clamped
    """

    scale: int = 4
    frames: int = 41
    pattern: str = "RGGB"
    alpha: float = 0.4
    halo: int | None = None
    takes_flow: bool = True
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
        self.error_model = ErrorModel()
        self.motion = ClassicalFlow() if motion is None else motion

    @property
    def settings(self) -> dict[str, Any]:
        """What the network was built with, by name, as plain values."""
        if self._settings is not None:
            return self._settings
        names = dict.fromkeys((*_ALL_HAVE, *signature(type(self)).parameters))
        return {name: getattr(self, name) for name in names if hasattr(self, name) and name != "motion"}

    @property
    def flow_times(self) -> tuple[int, int, int]:
        """Spike frames that the flows run between: the first, the middle and the last time point."""
        return self._flow_times or (5, self.frames // 2, self.frames - 6)

    @classmethod
    def from_pretrained(cls, weights: str | Path, motion: MotionEstimator | None = None, **arguments: Any) -> Self:
        """Build the network that weights belong to, this class or a subclass, and load them.

        Args:
            weights: the name of weights that come with the package, such as ``"cscsr_small_x4"``; a file of
                safetensors; or a checkpoint of ``lightning fit``.
            motion: estimator that is asked where no flow is given; when not given, the one inside the weights, or
                :class:`lightning_modules.motion.ClassicalFlow` where none is.
            arguments: of the constructor, such as ``alpha``, that weights serve with any of.

        Returns:
            The network, in evaluation mode, on the CPU.

        Raises:
            FileNotFoundError: neither a file nor the name of one; the message says which names there are.
            ValueError: a file that is damaged, or of another kind of network; an estimator for one that takes no flow.
        """
        found = read_weights(weights)
        named = found.settings.get("class")
        kind = next((kind for kind in _family(cls) if kind.__name__ == named), None)
        if kind is None:
            raise ValueError(f"{weights}: expected weights of {cls.__name__}, got those of {named}")
        takes = signature(kind).parameters
        # a user's own constructor need not take all that every network has
        missing = set() if _ours(kind) else {*_ALL_HAVE} - takes.keys()
        settings = {name: value for name, value in found.settings.items() if name not in missing}
        check_weights(replace(found, settings=settings), {named: kind, **ESTIMATORS})
        settings.pop("class")
        own = motion is not None
        same = own and type(motion).__name__ == found.motion.get("class") and found.motion["class"] not in ESTIMATORS
        if own and not kind.takes_flow:
            raise ValueError(f"motion: {named} takes no flow, expected none, got {type(motion).__name__}")
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
        """Multiply the picture by a factor, in the weights, once and for all.

        A camera of twice the gain sees a scene as the other sees one twice as bright: the same spikes, half the
        picture. A network whose input is divided by alpha does this already; others override this method.
        """

    def check_spikes(self, spikes: Tensor) -> None:
        """Raise unless the network can take a clip.

        Raises:
            TypeError: not a tensor of real numbers.
            ValueError: another number of frames, or less than 3 x 3 pixels.
        """
        check_planes("spikes", spikes, 4, "(B, N, H, W)")
        if spikes.ndim != 4 or spikes.shape[1] != self.frames or min(spikes.shape[-2:]) < 3:
            expected = f"(B, {self.frames}, H, W) of at least 3 x 3 pixels"
            raise ValueError(f"spikes: expected {expected}, got {tuple(spikes.shape)}")

    def estimate_flow(self, spikes: Tensor) -> Tensor:
        """Flows from the middle to the first and to the last time point, (B, 2, 2, H, W), in sensor pixels."""
        return torch.stack(self.motion(spikes, self.flow_times, self.pattern), dim=1)

    def resolve_flow(self, spikes: Tensor, flow: Tensor | None, static: bool) -> Tensor | None:
        """Return the flow that is given, or the network's own estimate, or None where nothing moves.

        Raises:
            ValueError: a flow of another size, or both a flow and ``static``.
            RuntimeError: ``torch.jit.trace``, which would keep the motion of its example.
        """
        if static and flow is not None:
            raise ValueError("flow, static: expected a flow or static=True, got both")
        if static or (flow is None and self.motion.static):
            return None
        if torch.jit.is_tracing():  # not of torch.compile and torch.export, which see the code
            raise RuntimeError(
                "torch.jit.trace: expected static=True or ZeroFlow, as a trace would keep the motion of its example "
                "for every clip; torch.compile keeps none"
            )
        if flow is None and is_exporting():
            raise ValueError("flow: expected it as an input, as the estimate of motion cannot be exported, got none")
        if flow is None:
            flow = self.estimate_flow(spikes)
        shapes = [(len(spikes), *groups, 2, 2, *spikes.shape[-2:]) for groups in self.flow_groups]
        # number by number: the compiler finds no shape in a list where it knows one side of the picture alone
        same = (flow.ndim == len(shape) and all(map(eq, flow.shape, shape)) for shape in shapes)
        if not isinstance(flow, Tensor) or not any(same):
            got = tuple(flow.shape) if isinstance(flow, Tensor) else f"{flow!r}; static=True says that nothing moves"
            raise ValueError(f"flow: expected {' or '.join(map(str, shapes))}, got {got}")
        return flow


def _family(kind: type[Network]) -> Iterator[type[Network]]:
    """A class and what derives from it in this package: a file builds no other class by its name."""
    yield kind
    for child in kind.__subclasses__():
        if _ours(child):
            yield from _family(child)


def _ours(kind: type[Network]) -> bool:
    return kind.__module__.startswith(f"{__package__}.")


def read_network(weights: str | Path) -> nn.Module:
    """Build the network or the estimator of motion that weights belong to, ready to be trained.

    Args:
        weights: as :meth:`Network.from_pretrained` takes them.

    Raises:
        FileNotFoundError: neither a file nor the name of one.
        ValueError: a file that is damaged, or of no class of this package.
    """
    found = read_weights(weights)
    if found.settings.get("class") not in ESTIMATORS:
        return Network.from_pretrained(weights).train()
    kind, arguments = own_class(found.settings, found.source, ESTIMATORS)
    estimator = kind(**arguments)
    load_weights(estimator, found)
    return estimator

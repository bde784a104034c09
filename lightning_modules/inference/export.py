"""Export networks as programs of torch.export or as ONNX."""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from lightning_modules.inference.tiles import call
from lightning_modules.networks import Network, RecurrentCSCSR
from spikekit.io.whole_file import write_whole

#: file endings of the formats
FORMATS = {"torch": ".pt2", "onnx": ".onnx"}

#: opset of ONNX
OPSET = 20

_TRACED = 32, 44  # size of the traced clip, in sensor pixels
_SIZES = (32, 44), (20, 16), (24, 48)
_WITHIN = 1e-4


class _Still(nn.Module):
    """A network without a flow input: nothing moves."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, spikes: Tensor) -> Tensor:
        return call(self.network, spikes, static=True)


class _Moving(_Still):
    """A network with a flow input."""

    def forward(self, spikes: Tensor, flow: Tensor) -> Tensor:
        return self.network(spikes, flow)


class _StillFilm(_Still):
    """A network for films; its second input is the state of the previous key frame, zeros for the first."""

    def forward(self, spikes: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        return self._meet(spikes, None, state, None)

    def _meet(self, spikes: Tensor, flow: Tensor | None, state: Tensor, way: Tensor | None) -> tuple[Tensor, Tensor]:
        features = self.network.features(spikes, flow)
        met = self.network.advance(features, spikes, self.network.moved(state, way))
        state = torch.where((state != 0).any(), met, self.network.advance(features, spikes))
        return self.network.picture(state), state


class _Film(_StillFilm):
    """A network for films that takes the flow and the number of clocks since the previous key frame, too."""

    def forward(self, spikes: Tensor, flow: Tensor, state: Tensor, every: Tensor) -> tuple[Tensor, Tensor]:
        return self._meet(spikes, flow, state, self.network.flow_to(flow, -1) * every)


def export_network(network: Network, path: str | Path, kind: str, *, still: bool = False) -> str:
    """Export a network with torch.export or as ONNX, and compare the result with the network on three sizes.

    The exported program takes ``spikes``, (1, N, H, W), float32 zeros and ones, H and W even and at least 16. A network
    that follows motion also takes ``flow``, as ``network.estimate_flow(spikes)`` returns it. The output is ``rgb``,
    (1, 3, s H, s W), not clamped.

    A network for films has a second output, ``next_state``, (1, C, H, W). Its input ``state`` is the ``next_state`` of
    the previous key frame, zeros for the first. With a flow it also takes ``every``, the number of clocks since
    the previous key frame, a float32 scalar.

    Args:
        network: network of :mod:`lightning_modules.networks`.
        path: file to write, ``.pt2`` or ``.onnx``.
        kind: ``"torch"`` or ``"onnx"``.
        still: nothing moves; the program has no flow input.

    Returns:
        Names and shapes of the inputs and the measured difference, in words.

    Raises:
        ValueError: the network cannot be exported, or its export differs by more than 1e-4.
        ImportError: a package for ONNX is missing; the message tells how to install it.
    """
    if kind == "onnx":
        _check_onnx()
    network = network.eval().cpu().float()
    films = isinstance(network, RecurrentCSCSR)
    module = as_exported(network, still)
    try:
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            clips = [example_inputs(network, size, still) for size in (_TRACED, *_SIZES)]
            if films:
                clips[-1]["state"] = torch.zeros_like(clips[-1]["state"])  # first key frame of a film
            program = _program(module, clips[0])
            data = (_onnx if kind == "onnx" else _torch)(program, list(clips[0]), ["rgb", "next_state"][: 1 + films])
            run = exported(data, kind)
            # max() of a tensor keeps NaN, that of Python numbers does not
            tried = [difference(run(*clip.values()), module(*clip.values())) for clip in clips[1:]]
            worst = torch.stack(tried).max().item()
    except Exception as error:  # the type depends on the operator that torch cannot trace
        raise ValueError(f"{type(network).__name__}: cannot be exported ({_reason(error)})") from error
    if not worst <= _WITHIN:
        raise ValueError(
            f"{type(network).__name__}: expected an export within {_WITHIN} of the network, got {worst:.2g}"
        )
    write_whole(path, data)
    takes = " and ".join(f"{name} {_shape(value)}" for name, value in clips[0].items())
    return f"takes {takes}, H and W even, within {worst:.1g} of the network"


def as_exported(network: Network, still: bool = False) -> nn.Module:
    """Return the module to export; it takes the values of :func:`example_inputs`, in order."""
    kinds = (_StillFilm, _Film) if isinstance(network, RecurrentCSCSR) else (_Still, _Moving)
    return kinds[_moves(network, still)](network)


def _moves(network: Network, still: bool) -> bool:
    return network.takes_flow and not network.motion.static and not still


def example_inputs(network: Network, size: tuple[int, int], still: bool = False) -> dict[str, Tensor]:
    """Return reproducible example inputs for a sensor of ``size`` by name: random spikes, flow and state."""
    moves, films = _moves(network, still), isinstance(network, RecurrentCSCSR)
    generator = torch.Generator().manual_seed(0)
    found = {"spikes": (torch.rand(1, network.frames, *size, generator=generator) < 0.3).float()}
    if moves:
        # One motion per quarter: of many motions, some are midway between two search positions, where rounding decides.
        groups = network.estimate_flow(found["spikes"]).shape[:-2]
        quarters = torch.randn(*groups, 2, 2, generator=generator)
        found["flow"] = quarters.repeat_interleave(size[0] // 2, -2).repeat_interleave(size[1] // 2, -1)
    if films:
        channels = network.colors * network.scale**2 + network.config.memory
        found["state"] = torch.rand(1, channels, *size, generator=generator)
    if films and moves:
        found["every"] = torch.tensor(20.0)
    return found


def _program(module: nn.Module, inputs: dict[str, Tensor]) -> torch.export.ExportedProgram:
    height, width = (2 * torch.export.Dim(name, min=8, max=2048) for name in ("half_height", "half_width"))
    open_sizes = {
        name: {value.ndim - 2: height, value.ndim - 1: width} if value.ndim else None for name, value in inputs.items()
    }
    return torch.export.export(module, tuple(inputs.values()), dynamic_shapes=open_sizes, strict=False)


def difference(found: Tensor | Sequence[Tensor], expected: Tensor | Sequence[Tensor]) -> Tensor:
    """Return the largest absolute difference of two results; NaN if either contains NaN."""
    pairs = zip(*([one] if isinstance(one, Tensor) else one for one in (found, expected)), strict=True)
    return torch.stack([(got - wanted).abs().max() for got, wanted in pairs]).max()


def _shape(value: Tensor) -> str:
    return f"({', '.join([*map(str, value.shape[:-2]), 'H', 'W'])})" if value.ndim else "()"


def _reason(error: BaseException) -> str:
    while error.__cause__ is not None:  # the first error has the reason
        error = error.__cause__
    return ((str(error).strip() or type(error).__name__).splitlines())[0][:200]


def exported(data: bytes, kind: str, threads: int | None = None) -> Callable[..., Any]:
    """Return a function that runs an exported program, ``"torch"`` or ``"onnx"``, in this process.

    It takes the inputs in order and returns the picture; for films, the picture and the state.
    """
    if kind == "torch":
        return torch.export.load(io.BytesIO(data)).module()
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # hide warnings on constants that are not folded
    options.intra_op_num_threads = threads or 0
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])

    def run(*inputs: Tensor) -> Any:
        given = {one.name: value.numpy() for one, value in zip(session.get_inputs(), inputs, strict=True)}
        found = [torch.from_numpy(value) for value in session.run(None, given)]
        return found[0] if len(found) == 1 else found

    return run


def _torch(program: torch.export.ExportedProgram, inputs: list[str], outputs: list[str]) -> bytes:
    file = io.BytesIO()
    torch.export.save(program, file)
    return file.getvalue()


def _onnx(program: torch.export.ExportedProgram, inputs: list[str], outputs: list[str]) -> bytes:
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # hide the hint to install torchvision, not needed
    # the optimiser takes minutes, and onnxruntime has its own
    options = {"dynamo": True, "optimize": False, "verbose": False, "opset_version": OPSET}
    model = torch.onnx.export(program, input_names=inputs, output_names=outputs, **options).model_proto
    for node in model.graph.node:
        node.ClearField("metadata_props")  # a tenth of the file, and it tells the paths of the source
    return model.SerializeToString()


def _check_onnx() -> None:
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise ImportError(
            f"onnx: expected {error.name}: pip install '.[export]' in a clone of the repository"
        ) from error

"""Networks for other programs: programs of torch.export, and ONNX."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from lightning_modules.networks import Network
from spikekit.io.whole_file import whole_file

#: formats, and how their files end
FORMATS = {"torch": ".pt2", "onnx": ".onnx"}

#: of ONNX
OPSET = 20

_TRACED = 32, 44  # sensor pixels, of the clip that the network is followed on
_SIZES = (32, 44), (16, 20), (24, 48)
_WITHIN = 1e-4


class _Still(nn.Module):
    """A network of which nobody gives the motion."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, spikes: Tensor) -> Tensor:
        return self.network(spikes, static=True)


class _Moving(nn.Module):
    """A network that is given the motion."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, spikes: Tensor, flow: Tensor) -> Tensor:
        return self.network(spikes, flow)


def export_network(network: Network, path: str | Path, kind: str, *, still: bool = False) -> str:
    """Write a network as a program of torch.export or as ONNX, after a comparison with itself on three sizes.

    Its inputs are ``spikes``, (1, N, H, W), float32 zeros and ones, H and W even and 16 or more, and ``flow``, from the
    middle to the first and to the last time point, (1, 2, 2, H, W), in sensor pixels, where the network follows motion.
    Its output is ``rgb``, (1, 3, s H, s W), not clamped.

    Args:
        network: any of :mod:`lightning_modules.networks`; what cannot be followed is refused.
        path: where to, ``.pt2`` or ``.onnx``.
        kind: ``"torch"`` or ``"onnx"``.
        still: nothing moves: ``spikes`` are the only input.

    Returns:
        What was written, in words.

    Raises:
        ValueError: a network that cannot be exported, or whose export differs by more than 1e-4.
        ImportError: a package that writes ONNX is missing; the message says how to install it.
    """
    if kind == "onnx":
        _check_onnx()
    network = network.eval().cpu().float()
    moves = network.takes_flow and not network.motion.static and not still
    module = _Moving(network) if moves else _Still(network)
    height, width = (2 * torch.export.Dim(name, min=8, max=2048) for name in ("half_height", "half_width"))
    open_sizes = ({2: height, 3: width}, {3: height, 4: width})[: 1 + moves]
    try:
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            inputs = _example(network, _TRACED, moves)
            program = torch.export.export(module, inputs, dynamic_shapes=open_sizes, strict=False)
    except Exception as error:  # what torch raises depends on what it cannot follow
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
        raise ValueError(f"{type(network).__name__}: cannot be exported ({reason})") from error
    data = (_onnx if kind == "onnx" else _torch)(program, moves)
    run = exported(data, kind)
    with torch.no_grad():
        clips = [_example(network, size, moves) for size in _SIZES]
        # of a tensor, as max() of numbers forgets NaN
        worst = torch.stack([(run(*clip) - module(*clip)).abs().max() for clip in clips]).max().item()
    if not worst <= _WITHIN:
        raise ValueError(
            f"{type(network).__name__}: expected an export within {_WITHIN} of the network, got {worst:.2g}"
        )
    with whole_file(path) as file:
        file.write(data)
    takes = "spikes and flow" if moves else "spikes"
    return f"takes {takes} of any even height and width, within {worst:.1g} of the network"


def _example(network: Network, size: tuple[int, int], moves: bool) -> tuple[Tensor, ...]:
    generator = torch.Generator().manual_seed(0)
    spikes = (torch.rand(1, network.frames, *size, generator=generator) < 0.3).float()
    return (spikes, torch.randn(1, 2, 2, *size, generator=generator))[: 1 + moves]


def exported(data: bytes, kind: str, threads: int | None = None) -> Callable[..., Tensor]:
    """Return what runs an export, in this process.

    Args:
        data: the file.
        kind: ``"torch"`` or ``"onnx"``.
        threads: of onnxruntime, which takes all cores when not given; torch has its own.

    Returns:
        Takes the inputs in their order, and returns the picture.
    """
    if kind == "torch":
        return torch.export.load(io.BytesIO(data)).module()
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # what it cannot fold at load time is nobody's affair
    options.intra_op_num_threads = threads or 0
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    names = [one.name for one in session.get_inputs()]

    def run(*inputs: Tensor) -> Tensor:
        given = {name: value.numpy() for name, value in zip(names, inputs, strict=True)}
        return torch.from_numpy(session.run(None, given)[0])

    return run


def _torch(program: torch.export.ExportedProgram, moves: bool) -> bytes:
    file = io.BytesIO()
    torch.export.save(program, file)
    return file.getvalue()


def _onnx(program: torch.export.ExportedProgram, moves: bool) -> bytes:
    names = ["spikes", "flow"][: 1 + moves]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # its optimizer takes minutes, and onnxruntime has one of its own
        options = {"dynamo": True, "optimize": False, "verbose": False, "opset_version": OPSET}
        made = torch.onnx.export(program, input_names=names, output_names=["rgb"], **options)
    return made.model_proto.SerializeToString()


def _check_onnx() -> None:
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise ImportError(
            f"onnx: expected {error.name}: pip install '.[export]' in a clone of the repository"
        ) from error

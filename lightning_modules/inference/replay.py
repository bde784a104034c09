"""Networks on a GPU as CUDA graphs, where sizes repeat: a thousand launches take longer than their work."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from spikekit.kernels.graphs import Replayed


def run(part: Callable[..., Tensor], *tensors: Tensor | None) -> Tensor:
    """Call a method of a network, in the precision of autocast; replay it, on a GPU and without a gradient.

    Args:
        part: a bound method that never waits for the GPU.
        tensors: its arguments; the first is one.
    """
    given = [part for part in tensors if part is not None]
    if not given[0].is_cuda or torch.is_grad_enabled():
        return part(*tensors)
    half = torch.get_autocast_dtype("cuda") if torch.is_autocast_enabled("cuda") else None
    return _replayed((part, tuple(part is not None for part in tensors), half), *given)


def _call(argument: tuple[Any, ...], *given: Tensor) -> Tensor:
    part, there, half = argument
    rest: Iterator[Tensor] = iter(given)
    tensors = [next(rest) if is_there else None for is_there in there]
    # weights that autocast has kept from a call outside of the graph would be gone when it is replayed
    with torch.autocast("cuda", half or torch.bfloat16, enabled=half is not None, cache_enabled=False):
        return part(*tensors)


_replayed = Replayed(_call)

"""CUDA graphs, for functions whose kernel launches take longer than their work."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import RLock

import torch
from torch import Tensor

_CAPTURE = RLock()  # one capture at a time per process


class Replayed:
    """A function of tensors on a GPU, captured as a CUDA graph once per set of sizes, and replayed afterwards.

    The first call with new sizes runs normally, so that kernels are compiled and tuned; the second captures. No
    gradient. Results are copies, and the object is thread-safe. The function takes a hashable argument and tensors; it
    must have no side effects and no GPU synchronisation. Graphs for the last ``most`` sets of sizes are kept.
    """

    def __init__(self, function: Callable[..., Tensor], most: int = 8) -> None:
        self.function, self.most = function, most
        self._graphs: OrderedDict[Hashable, _Graph | bool | None] = OrderedDict()
        self._lock = RLock()

    @torch.no_grad()
    def __call__(self, argument: Hashable, *tensors: Tensor) -> Tensor:
        """Run the function or replay its graph."""
        if torch.cuda.is_current_stream_capturing():
            return self.function(argument, *tensors)
        key = argument, tensors[0].device, *((part.shape, part.dtype) for part in tensors)
        with self._lock:
            if key not in self._graphs:
                self._graphs[key] = None
                if len(self._graphs) > self.most:
                    self._graphs.popitem(last=False)
                return self.function(argument, *tensors)
            self._graphs.move_to_end(key)
            if self._graphs[key] is None:
                try:
                    self._graphs[key] = _Graph(self.function, argument, tensors)
                except RuntimeError:  # the function synchronises, or memory is short
                    self._graphs[key] = False
            graph = self._graphs[key]
            return graph.replay(tensors) if graph else self.function(argument, *tensors)


class _Graph:
    def __init__(self, function: Callable[..., Tensor], argument: Hashable, tensors: tuple[Tensor, ...]) -> None:
        self.graph, self.done = torch.cuda.CUDAGraph(), torch.cuda.Event()
        with _CAPTURE, torch.inference_mode(False), torch.no_grad(), torch.cuda.device(tensors[0].device):
            self.inputs = [torch.empty_like(part, memory_format=torch.contiguous_format) for part in tensors]
            torch.cuda.synchronize()
            with torch.cuda.graph(self.graph, capture_error_mode="thread_local"):
                self.output = function(argument, *self.inputs)

    def replay(self, tensors: tuple[Tensor, ...]) -> Tensor:
        self.done.wait()  # another stream may still read the last result
        for kept, part in zip(self.inputs, tensors, strict=True):
            kept.copy_(part)
        self.graph.replay()
        result = self.output.clone()
        self.done.record()
        return result

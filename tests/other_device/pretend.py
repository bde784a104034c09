"""A device where there is none: its tensors keep their values on the CPU and do not mix with the CPU's own.

It takes PyTorch's place for devices from elsewhere, ``PrivateUse1``, in the whole process.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.utils import backend_registration
from torch.utils._pytree import tree_flatten, tree_map_only

DEVICE = torch.device("privateuseone", 0)
_MOVES = ("aten::copy_", "aten::_to_copy")

#: what a GPU would have been waited for, since this was last cleared
waits: list[str] = []


class There(Tensor):
    """A tensor on the device; ``here`` has its values."""

    here: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, here: Tensor) -> There:
        tensor = Tensor._make_wrapper_subclass(
            cls,
            here.shape,
            strides=here.stride(),
            storage_offset=here.storage_offset(),
            dtype=here.dtype,
            device=DEVICE,
        )
        tensor.here = here
        return tensor

    def __repr__(self) -> str:
        return f"There({self.here})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name, kwargs = func.name(), kwargs or {}
        tensors = [value for value in tree_flatten((args, kwargs))[0] if isinstance(value, Tensor)]
        there = {id(tensor.here): tensor for tensor in tensors if isinstance(tensor, There)}
        if name not in _MOVES and any(tensor.ndim and not isinstance(tensor, There) for tensor in tensors):
            raise RuntimeError(f"{name}: some tensors are on the device, some are on the CPU")
        wanted = kwargs.get("device")
        stays = isinstance(args[0], There) if name == "aten::copy_" else wanted in (None, DEVICE)
        if not stays or name in ("aten::_local_scalar_dense", "aten::nonzero"):
            waits.append(name)
        if wanted is not None:
            kwargs = {**kwargs, "device": torch.device("cpu")}
        args, kwargs = tree_map_only(There, lambda tensor: tensor.here, (args, kwargs))
        result = func(*args, **kwargs)
        if not stays:
            return result
        return tree_map_only(Tensor, lambda here: there[id(here)] if id(here) in there else cls(here), result)


class _Module(backend_registration._DummyBackendModule):
    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.float16, torch.bfloat16]


@cache
def register() -> torch.library.Library:
    """Let this process have the device, as long as what is returned is kept."""
    backend_registration._setup_privateuseone_for_python_backend("pretend", backend_module=_Module())
    library = torch.library.Library("aten", "IMPL")

    def kernel(name: str) -> Callable[[Callable[..., Tensor]], object]:
        return lambda function: library.impl(name, function, "PrivateUse1")

    @kernel("empty.memory_format")
    def empty(size: Any, dtype: Any = None, *_: Any, memory_format: Any = None, **__: Any) -> Tensor:
        return There(torch.empty(size, dtype=dtype, memory_format=memory_format or torch.contiguous_format))

    @kernel("empty_strided")
    def empty_strided(size: Any, stride: Any, dtype: Any = None, *_: Any, **__: Any) -> Tensor:
        return There(torch.empty_strided(size, stride, dtype=dtype))

    # these would be made empty and grow
    @kernel("arange")
    def arange(end: Any, dtype: Any = None, *_: Any, **__: Any) -> Tensor:
        return There(torch.arange(end, dtype=dtype))

    @kernel("arange.start")
    def arange_start(start: Any, end: Any, dtype: Any = None, *_: Any, **__: Any) -> Tensor:
        return There(torch.arange(start, end, dtype=dtype))

    @kernel("arange.start_step")
    def arange_step(start: Any, end: Any, step: Any = 1, dtype: Any = None, *_: Any, **__: Any) -> Tensor:
        return There(torch.arange(start, end, step, dtype=dtype))

    @kernel("linspace")
    def linspace(start: Any, end: Any, steps: int, dtype: Any = None, *_: Any, **__: Any) -> Tensor:
        return There(torch.linspace(start, end, steps, dtype=dtype))

    @kernel("_copy_from")
    def copy_from(source: Tensor, target: There, non_blocking: bool = False) -> Tensor:
        target.here.copy_(source)
        return target

    return library

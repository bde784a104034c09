"""Import Lightning without three parts of other packages, which take more than half of the time.

Lightning reads few names of them, which stand-ins provide; any other name, and every name afterwards, comes from the
parts themselves.

Python's own ``importlib.util.LazyLoader`` does not serve: these names are read while Lightning and torchmetrics are
imported, which would load them at once, and imports inside of these are not ours to move.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from types import ModuleType
from typing import Any

import scipy  # noqa: F401 - before its part
import torch

_PLOT = "torchmetrics.utilities.plot"  # it imports Matplotlib
_PLOTS = "plot_confusion_matrix", "plot_curve", "plot_single_or_multi_val"
_PLOT_TYPES = "_AX_TYPE", "_CMAP_TYPE", "_PLOT_OUT_TYPE"  # which are read in annotations alone


class _Later(ModuleType):
    """Stands for a module of which some names are known; for others the module itself takes its place."""

    def __init__(self, name: str, **known: Any) -> None:
        super().__init__(name)
        vars(self).update(known, __path__=[])

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # what anybody asks any module for
            raise AttributeError(name)
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        return getattr(import_module(self.__name__), name)


class _OfCompiler(type):
    def __instancecheck__(cls, value: object) -> bool:
        # nothing is compiled before the compiler is imported
        compiler = sys.modules.get("torch._dynamo")
        return compiler is not None and isinstance(value, compiler.OptimizedModule)


class _OptimizedModule(metaclass=_OfCompiler):
    """What ``isinstance`` takes for the class of compiled modules."""


def _disable(function: Any, recursive: bool = True, reason: str | None = None) -> Any:
    # torch's own, which imports the compiler when the function is called
    return torch._disable_dynamo(function, recursive)


def _when_called(module: str, name: str) -> Callable[..., Any]:
    return lambda *args, **options: getattr(import_module(module), name)(*args, **options)


def import_lightning() -> None:
    """Import ``pytorch_lightning`` in half the time.

    Example:
        >>> import_lightning()
        >>> sys.modules["pytorch_lightning"].__name__
        'pytorch_lightning'
    """
    if "pytorch_lightning" in sys.modules:
        return
    compiler = {"OptimizedModule": _OptimizedModule, "disable": _disable}
    plots = {name: _when_called(_PLOT, name) for name in _PLOTS} | dict.fromkeys(_PLOT_TYPES, object)
    known = {"torch._dynamo": compiler, "scipy.signal": {"hamming": None}, _PLOT: plots}
    later = [_Later(name, **names) for name, names in known.items() if name not in sys.modules]
    sys.modules.update({module.__name__: module for module in later})
    with suppress(ImportError):  # another version may want more of them
        import_module("pytorch_lightning")
    for module in later:
        if sys.modules.get(module.__name__) is module:
            del sys.modules[module.__name__]
    import_module("pytorch_lightning")

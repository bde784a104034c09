"""Networks, data modules and commands for learning from spike streams, built on spikekit."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lightning_modules.inference.reconstruct import reconstruct
    from lightning_modules.networks import CSCSR
    from lightning_modules.registry import list_models
    from lightning_modules.tasks.super_resolution import SuperResolution

__all__ = ["CSCSR", "SuperResolution", "list_models", "reconstruct"]

# module of each public name
_HOME = {
    "CSCSR": "networks",
    "SuperResolution": "tasks.super_resolution",
    "list_models": "registry",
    "reconstruct": "inference.reconstruct",
}


def __getattr__(name: str) -> Any:
    """Import public names on first use, to keep the import of the package fast."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__]

"""spikekit: differentiable operators for the colour spike camera."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from spikekit import _renamed

if TYPE_CHECKING:
    from spikekit._public import *  # noqa: F403
    from spikekit._public import __all__ as __all__

__version__ = "0.1.0.dev0"

_OLD_DEMOSAIC = dict.fromkeys(("demosaic", "Demosaic"), "spikekit.color.demosaic")


def __getattr__(name: str) -> Any:
    """Import everything when the first of it is asked for: the commands answer ``--help`` without torch."""
    if name == "__all__" or not name.startswith("_"):
        from spikekit import _public

        globals().update({public: getattr(_public, public) for public in ("__all__", *_public.__all__)})
        if name in globals():
            return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    from spikekit._public import __all__

    return [*__all__, "__version__"]


# the old name of a module that a function has taken: as a module, it would take the place of the function
sys.modules["spikekit.demosaic"] = ModuleType("spikekit.demosaic")
sys.modules["spikekit.demosaic"].__getattr__ = _renamed.moved("spikekit.demosaic", _OLD_DEMOSAIC)

"""Old names that go on working: of modules, of their members, and of arguments."""

from __future__ import annotations

import functools
import importlib.util
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.machinery import ModuleSpec
from types import CodeType, ModuleType
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

RENAMED = {
    "spikekit.cfa": "spikekit.color.cfa",
    "spikekit.demosaic": "spikekit.color.demosaic",
    "spikekit.noise": "spikekit.sensor.noise",
    "spikekit.simulate": "spikekit.sensor.simulate",
    "lightning_modules.flicker": "spikekit.sensor.quantization_noise",
    "spikekit.keyframe": "spikekit.decoders.single_frame",
    "spikekit.streams": "spikekit.decoders.chunked",
    "spikekit.packing": "spikekit.decoders.packing",
    "spikekit.motion": "spikekit.flow.fields",
    "spikekit.interpolate": "spikekit.flow.interpolate",
    "lightning_modules.motion.tvl1": "spikekit.flow.tvl1",
    "lightning_modules.motion.cpu_tvl1": "spikekit.flow.cpu_tvl1",
    "spikekit.neighbors": "spikekit.warp.neighbors",
    "spikekit.table_warp": "spikekit.warp.table_warp",
    "spikekit.gather": "spikekit.warp.gather",
    "spikekit.position_table": "spikekit.kernels.position_table",
    "spikekit.scene": "spikekit.scenes.analytic",
    "spikekit.film": "spikekit.scenes.frame_sequence",
    "spikekit.interval": "spikekit.scenes.frame_interval",
    "spikekit.plan": "spikekit.scenes.adaptive_sampling",
    "spikekit.files": "spikekit.io.files",
    "spikekit.formats": "spikekit.io.formats",
    "spikekit.sidecar": "spikekit.io.sidecar",
    "spikekit.recording": "spikekit.io.recording",
    "spikekit.cameras": "spikekit.io.cameras",
    "spikekit.video": "spikekit.io.video",
    "spikekit.pictures": "spikekit.io.images",
    "spikekit.encoding": "spikekit.io.image_bytes",
    "spikekit.simulate_cli": "spikekit.cli.simulate",
    "spikekit.view_cli": "spikekit.cli.view",
    "spikekit.simulation": "spikekit.cli.simulation",
    "spikekit.drawing": "spikekit.cli.drawing",
    "spikekit.extremes.operators": "spikekit.examples",
    "spikekit.savings": "spikekit.bench.adaptive_sampling",
    "spikekit.bench.measure": "spikekit.timing",
    "lightning_modules.arguments": "lightning_modules.cli.arguments",
    "lightning_modules.callbacks": "lightning_modules.tasks.callbacks",
    "lightning_modules.flow_callbacks": "lightning_modules.tasks.flow_callbacks",
    "lightning_modules.module": "lightning_modules.tasks.super_resolution",
    "lightning_modules.flow_training": "lightning_modules.tasks.optical_flow",
    "lightning_modules.learner": "lightning_modules.tasks.base",
    "lightning_modules.tiles": "lightning_modules.inference.tiles",
    "lightning_modules.look": "lightning_modules.inference.scene_activity",
    "lightning_modules.self_ensemble": "lightning_modules.inference.self_ensemble",
    "lightning_modules.speed": "lightning_modules.inference.presets",
    "lightning_modules.networks.rest": "lightning_modules.networks.static_scene",
    "lightning_modules.savings": "lightning_modules.trade.adaptive",
    "lightning_modules.trade.energy": "lightning_modules.cost.energy",
    "lightning_modules.trade.measure": "lightning_modules.cost.measure",
    "lightning_modules.trade.runner": "lightning_modules.cost.runner",
    "lightning_modules.quality": "lightning_modules.metrics.image",
    "lightning_modules.flow_metrics": "lightning_modules.metrics.flow",
    "lightning_modules.pretrained": "lightning_modules.storage.pretrained",
    "lightning_modules.shipped": "lightning_modules.storage.shipped",
    "lightning_modules.stored_settings": "lightning_modules.storage.settings",
    "lightning_modules.checkpoint": "lightning_modules.storage.checkpoint",
    "lightning_modules.error_model": "lightning_modules.storage.error_model",
    "lightning_modules.training_state": "lightning_modules.tasks.training_state",
    "lightning_modules.exporting": "lightning_modules.inference.export",
    "lightning_modules.charts": "lightning_modules.cost.charts",
}


class RenamedModules:
    """Finds modules by their old names, for those that no other finder knows; ``python -m`` finds them, too."""

    @staticmethod
    def find_spec(name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return where an old name leads, nothing for other names."""
        return ModuleSpec(name, RenamedModules) if name in RENAMED else None

    @staticmethod
    def create_module(spec: ModuleSpec) -> None:
        """Leave it to Python to make a module, which :meth:`exec_module` replaces."""

    @staticmethod
    def exec_module(module: ModuleType) -> None:
        """Put the module of the new name in the place of the one of the old name."""
        sys.modules[module.__name__] = importlib.import_module(RENAMED[module.__name__])

    @staticmethod
    def get_code(name: str) -> CodeType | None:
        """Return the code that ``python -m`` runs."""
        spec = importlib.util.find_spec(RENAMED[name])
        return spec.loader.get_code(spec.name)


def moved(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package that was one module: what moved on is looked up where it is now.

    Args:
        package: its name.
        homes: where each name is now, by name.
    """

    def __getattr__(name: str) -> Any:  # noqa: N807
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(homes[name]), name)

    return __getattr__


def renamed_argument(old: str, new: str) -> Callable[[F], F]:
    """Let a function take a keyword argument by its old name as well.

    Example:
        >>> @renamed_argument("tolerance", "spike_tolerance")
        ... def plan(*, spike_tolerance):
        ...     return spike_tolerance
        >>> plan(tolerance=0.1)
        0.1
    """

    def decorate(function: F) -> F:
        @functools.wraps(function)
        def call(*args: Any, **keywords: Any) -> Any:
            if old in keywords:
                if new in keywords:
                    raise TypeError(f"{old}: expected {new} alone, of which it is the old name, got both")
                keywords[new] = keywords.pop(old)
            return function(*args, **keywords)

        return call

    return decorate


sys.meta_path.append(RenamedModules)

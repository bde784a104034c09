"""Energy counters: NVML on NVIDIA GPUs, RAPL on CPUs under Linux."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path

import torch

#: where Linux shows the counters of RAPL
POWERCAP = Path("/sys/class/powercap")

_SECONDS = 1.0  # the counters move in steps of up to a tenth of a second

#: Returns joules, counted from some time on.
Meter = Callable[[], float]


def energy_meter(device: torch.device) -> Meter | None:
    """Return a counter of a device's joules, which includes everything that runs on it; None if there is no counter."""
    return _gpu_meter(device) if device.type == "cuda" else _cpu_meter()


def energy_per_call(run: Callable[[], object], meter: Meter, seconds: float = _SECONDS) -> float:
    """Return the joules of one call, by calling for some time.

    Args:
        run: what is called; on a GPU it must wait for its result.
        meter: see :func:`energy_meter`.
        seconds: how long.

    Example:
        >>> count = iter([5.0, 17.0])
        >>> energy_per_call(lambda: None, lambda: next(count), seconds=0)
        12.0
    """
    calls, began, before = 0, time.monotonic(), meter()
    while not calls or time.monotonic() - began < seconds:
        run()
        calls += 1
    return (meter() - before) / calls


def _gpu_meter(device: torch.device) -> Meter | None:
    try:
        import pynvml

        pynvml.nvmlInit()
        uuid = str(torch.cuda.get_device_properties(device).uuid)
        handle = pynvml.nvmlDeviceGetHandleByUUID(uuid if uuid.startswith("GPU-") else f"GPU-{uuid}")
        pynvml.nvmlDeviceGetTotalEnergyConsumption(handle)
    except Exception:  # not installed, no permission, a GPU without the counter: none is worth more than an empty cell
        return None
    return lambda: pynvml.nvmlDeviceGetTotalEnergyConsumption(handle) / 1e3


def _cpu_meter() -> Meter | None:
    counters = [folder for folder in POWERCAP.glob("intel-rapl:*") if re.fullmatch(r"intel-rapl:\d+", folder.name)]
    try:
        last = {folder: _microjoules(folder, "energy_uj") for folder in counters}
        ends = {folder: _microjoules(folder, "max_energy_range_uj") for folder in counters}
    except (OSError, ValueError):  # most systems let only root read them
        return None
    if not counters:
        return None
    total = 0

    def meter() -> float:
        nonlocal total
        for folder in counters:
            now = _microjoules(folder, "energy_uj")
            total += (now - last[folder]) % (ends[folder] + 1)  # it starts again from 0
            last[folder] = now
        return total / 1e6

    return meter


def _microjoules(folder: Path, name: str) -> int:
    return int((folder / name).read_text())

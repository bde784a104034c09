"""Energy of NVIDIA GPUs, by the counter of NVML."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

_SECONDS = 1.0  # the counter moves in steps of up to a tenth of a second

#: Returns joules, counted from some time on.
Meter = Callable[[], float]


def energy_meter(device: torch.device) -> Meter | None:
    """Return a counter of a GPU's joules, which includes everything that runs on it; None if there is no counter."""
    try:
        import pynvml

        pynvml.nvmlInit()
        uuid = str(torch.cuda.get_device_properties(device).uuid)
        handle = pynvml.nvmlDeviceGetHandleByUUID(uuid if uuid.startswith("GPU-") else f"GPU-{uuid}")
        pynvml.nvmlDeviceGetTotalEnergyConsumption(handle)
    except Exception:  # not installed, no permission, no GPU or counter: none is worth more than an empty cell
        return None
    return lambda: pynvml.nvmlDeviceGetTotalEnergyConsumption(handle) / 1e3


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

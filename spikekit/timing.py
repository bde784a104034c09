"""Time and memory of a call, and a description of machine and software."""

from __future__ import annotations

import ctypes
import platform
import re
import sys
import time
import timeit
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

Run = Callable[[], object]

#: Takes a run and a number of calls; returns seconds per call.
Timer = Callable[[Run, int], float]


def duration(seconds: float) -> str:
    """Format a duration.

    Example:
        >>> [duration(time) for time in (0.21, 47.4, 192.0, 15_500.0)]
        ['0.2 s', '47 s', '3 min 12 s', '4 h 18 min']
    """
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes_left = divmod(minutes, 60)
    return f"{hours} h {minutes_left} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def cuda_timer(run: Run, number: int) -> float:
    """Return seconds per call by CUDA events, synchronised before and after."""
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    torch.cuda.synchronize()
    begin.record()
    for _ in range(number):
        run()
    end.record()
    torch.cuda.synchronize()
    return begin.elapsed_time(end) / 1e3 / number


def timer_of(device: torch.device, threads: int) -> tuple[Timer, str]:
    """Return the timer for a device and a number of threads, and its description."""
    if device.type == "cuda":
        return cuda_timer, "CUDA events, synchronised"
    now, said = (time.process_time, "process CPU time") if threads == 1 else (time.perf_counter, "wall time")
    return lambda run, number: timeit.timeit(run, timer=now, number=number) / number, said


def cpu_name() -> str:
    """Return the model name of the processor."""
    with suppress(OSError, AttributeError):
        return re.search(r"^model name\s*:\s*(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)[1]  # type: ignore[index]
    return platform.processor() or platform.machine()


def software() -> str:
    """Return a line with the versions of the software that affects times."""
    try:
        numba = f"Numba {version('numba')}"
    except PackageNotFoundError:
        numba = "no Numba"
    return f"torch    {torch.__version__}, {numba}, Python {platform.python_version()}, {platform.system()}"


def peak_memory(run: Run, device: torch.device) -> float | None:
    """Return the peak memory of a call, result included, in MiB above the memory in use before.

    CUDA: memory of torch's allocator. CPU: resident memory of the process, all libraries included; only on Linux, if
    its high-water mark can be reset, else None.
    """
    if device.type == "cuda":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        run()
        torch.cuda.synchronize()
        return (torch.cuda.max_memory_allocated() - before) / 2**20
    if sys.platform != "linux":
        return None
    with suppress(OSError, AttributeError):  # only glibc; free pages that the heap keeps would hide a part
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5")
        before = _resident("VmRSS")
        run()
        return max(0, _resident("VmHWM") - before) / 1024
    except (OSError, LookupError):
        return None


def _resident(field: str) -> int:
    found = re.search(rf"^{field}:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    if found is None:
        raise LookupError(field)
    return int(found[1])

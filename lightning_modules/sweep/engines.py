"""Engines: trials in separate processes, on this machine or on a Ray cluster."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from lightning_modules.cli.processes import calls_on_ray, exit_reason, run_to_end, start, stop
from lightning_modules.sweep.state import LOG

_A_MOMENT = 0.2  # seconds

#: finished trials, each with the reason of its failure or ``None``
Ended = dict[Path, str | None]


def run_locally(folders: Sequence[Path], jobs: int | None, every: float) -> Iterator[Ended]:
    """Run trials on this machine, ``jobs`` at once with a share of the cores; repeatedly yield the finished ones."""
    jobs = jobs or 1
    threads = {"OMP_NUM_THREADS": str(max(1, torch.get_num_threads() // jobs))} if jobs > 1 else {}
    waiting, running = list(folders), {}
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                folder = waiting.pop(0)
                running[folder] = start(folder / LOG, _trial(folder, every), threads)
            time.sleep(_A_MOMENT)
            ended = [folder for folder, process in running.items() if process.poll() is not None]
            yield {folder: exit_reason(folder / LOG, running.pop(folder).returncode) for folder in ended}
    finally:
        for process in running.values():
            stop(process)


def run_on_ray(folders: Sequence[Path], jobs: int | None, every: float) -> Iterator[Ended]:
    """Run trials on the Ray cluster of ``RAY_ADDRESS``, else on a running one, else on a new one on this machine.

    A trial takes one GPU, or all cores of a node if the cluster has no GPU; with ``jobs``, a share that lets as many
    run at once. All nodes need this package, the working directory and the folders under the same paths.
    """
    here = os.getcwd()
    calls = {
        folder: (run_to_end, folder.absolute() / LOG, _trial(folder.absolute(), every), here) for folder in folders
    }
    return calls_on_ray(lambda _: calls, jobs)


def _trial(folder: Path, every: float) -> list[str]:
    return ["-m", "lightning_modules.sweep.worker", str(folder), str(every)]

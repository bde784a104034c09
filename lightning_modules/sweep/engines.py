"""Engines of a sweep: trials in processes of their own, on this machine or on a Ray cluster."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from lightning_modules.sweep.state import LOG

_A_MOMENT = 0.2  # seconds

#: the trials that ended, with what went wrong: ``None`` if nothing did
Ended = dict[Path, str | None]


def run_locally(folders: Sequence[Path], jobs: int | None, every: float) -> Iterator[Ended]:
    """Run trials on this machine, and say again and again which ones ended.

    Args:
        folders: of the trials.
        jobs: trials at once, which share the cores; one if ``None``.
        every: seconds between two checkpoints.
    """
    jobs = jobs or 1
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads = {"OMP_NUM_THREADS": str(max(1, cores // jobs))} if jobs > 1 else {}
    waiting, running = list(folders), {}
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                folder = waiting.pop(0)
                running[folder] = _start(folder, every, threads)
            time.sleep(_A_MOMENT)
            ended = [folder for folder, process in running.items() if process.poll() is not None]
            yield {folder: _reason(folder, running.pop(folder).returncode) for folder in ended}
    finally:
        for process in running.values():
            _stop(process)


def run_on_ray(folders: Sequence[Path], jobs: int | None, every: float) -> Iterator[Ended]:
    """Run trials on the Ray cluster that ``RAY_ADDRESS`` names or that runs here, else on a Ray of this machine's own.

    A trial takes a GPU where the cluster has any, else the cores of a node; with ``jobs``, such a share of all that as
    many run at once. All nodes need this package, the working directory and the folders, under the same paths.

    Args:
        folders: of the trials.
        jobs: trials at once; as many as there are GPUs, or else nodes, if ``None``.
        every: seconds between two checkpoints.
    """
    import ray

    ray.init(log_to_driver=False, include_dashboard=False, logging_level="ERROR")
    try:
        share = _share([node["Resources"] for node in ray.nodes() if node["Alive"]], jobs)
        task = ray.remote(max_retries=0, **share)(_run_to_end)
        running = {task.remote(folder.absolute(), every, os.getcwd()): folder for folder in folders}
        while running:
            done, _ = ray.wait(list(running), timeout=_A_MOMENT)
            yield {running.pop(reference): _outcome(ray, reference) for reference in done}
    finally:
        ray.shutdown()


def _share(nodes: Sequence[dict[str, float]], jobs: int | None) -> dict[str, Any]:
    """Return what a trial takes of a cluster.

    Example:
        >>> _share([{"CPU": 16, "GPU": 2}, {"CPU": 8, "GPU": 2}], None)
        {'num_cpus': 4, 'num_gpus': 1.0}
        >>> _share([{"CPU": 8}], 4)
        {'num_cpus': 2}
    """
    gpus = sum(node.get("GPU", 0) for node in nodes)
    if gpus:
        gpu = gpus / max(jobs or gpus, 1)
        gpu = min(1.0, gpu)
        cpus = min(node.get("CPU", 0) / node["GPU"] for node in nodes if node.get("GPU")) * gpu
        return {"num_cpus": int(cpus), "num_gpus": gpu}
    a_node = -(-(jobs or len(nodes)) // len(nodes))
    return {"num_cpus": max(1, int(min(node.get("CPU", 1) for node in nodes) // a_node))}


def _run_to_end(folder: Path, every: float, there: str) -> str | None:
    os.chdir(there)
    process = _start(folder, every, {})
    try:
        return _reason(folder, process.wait())
    finally:
        _stop(process)


def _outcome(ray: Any, reference: Any) -> str | None:
    try:
        return ray.get(reference)
    except ray.exceptions.RayError as error:
        return f"Ray: {str(error).strip().splitlines()[0]}"


def _start(folder: Path, every: float, environment: dict[str, str]) -> subprocess.Popen:
    # Threads that spin while they wait hold up the workers that make clips.
    environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, **environment}
    with open(folder / LOG, "ab") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "lightning_modules.sweep.worker", str(folder), str(every)],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment,
        )


def _stop(process: subprocess.Popen) -> None:
    process.stdin.close()
    process.wait()


def _reason(folder: Path, status: int) -> str | None:
    if status == 0:
        return None
    if status < 0:
        name = signal.Signals(-status).name
        return f"killed by {name}" + (", perhaps for want of memory" if name == "SIGKILL" else "")
    lines = (folder / LOG).read_text(errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), f"status {status}")
    return last.removeprefix("lightning: ")

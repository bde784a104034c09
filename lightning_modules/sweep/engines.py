"""Engines: trials, or parts of other work, in processes of their own, on this machine or on a Ray cluster."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from lightning_modules.cli.errors import InputError
from lightning_modules.sweep.state import LOG
from spikekit.arguments import one_line

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
                running[folder] = _start(folder / LOG, _trial(folder, every), threads)
            time.sleep(_A_MOMENT)
            ended = [folder for folder, process in running.items() if process.poll() is not None]
            yield {folder: _reason(folder / LOG, running.pop(folder).returncode) for folder in ended}
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
    logs = {folder.absolute() / LOG: folder for folder in folders}
    for ended in run_commands_on_ray(lambda _: {log: _trial(log.parent, every) for log in logs}, jobs):
        yield {logs[log]: reason for log, reason in ended.items()}


def run_commands_on_ray(
    commands: Callable[[int], dict[Path, Sequence[str]]], jobs: int | None
) -> Iterator[dict[Path, str | None]]:
    """Run Python on a Ray cluster as :func:`run_on_ray` does, and say again and again which commands ended, and how.

    Args:
        commands: given how many run at once, the arguments of Python by the file that a command's output goes to.
        jobs: commands at once; as many as there are GPUs, or else nodes, if ``None``.
    """
    import ray

    try:
        ray.init(log_to_driver=False, include_dashboard=False, logging_level="ERROR")
    except Exception as error:  # Ray raises its plainest kind where a machine is too busy to start it
        raise InputError(f"--engine ray: {one_line(error)}") from error
    try:
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        share = _share(nodes, jobs)
        at_once = jobs or int(sum(node.get("GPU", 0) for node in nodes)) or len(nodes)
        task = ray.remote(max_retries=0, **share)(_run_to_end)
        running = {task.remote(log, words, os.getcwd()): log for log, words in commands(at_once).items()}
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


def _run_to_end(log: Path, words: Sequence[str], there: str) -> str | None:
    os.chdir(there)
    process = _start(log, words, {})
    try:
        return _reason(log, process.wait())
    finally:
        _stop(process)


def _outcome(ray: Any, reference: Any) -> str | None:
    try:
        return ray.get(reference)
    except ray.exceptions.RayError as error:
        return f"Ray: {str(error).strip().splitlines()[0]}"


def _trial(folder: Path, every: float) -> list[str]:
    return ["-m", "lightning_modules.sweep.worker", str(folder), str(every)]


def _start(log: Path, words: Sequence[str], environment: dict[str, str]) -> subprocess.Popen:
    # Threads that spin while they wait hold up the workers that make clips.
    environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, **environment}
    with open(log, "ab") as file:
        return subprocess.Popen(
            [sys.executable, *words],
            stdin=subprocess.PIPE,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=environment,
        )


def _stop(process: subprocess.Popen) -> None:
    process.stdin.close()
    process.wait()


def end_with_parent() -> None:
    """Stop where the one that started this process does, even when it is killed: our standard input then closes."""

    def wait() -> None:
        while os.read(0, 1):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _reason(log: Path, status: int) -> str | None:
    if status == 0:
        return None
    if status < 0:
        name = signal.Signals(-status).name
        return f"killed by {name}" + (", perhaps for want of memory" if name == "SIGKILL" else "")
    lines = log.read_text(errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), f"status {status}")
    return last.removeprefix("lightning: ")

"""Run Python in separate processes, on this machine or on a Ray cluster."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from lightning_modules.cli.errors import InputError
from spikekit.arguments import one_line, printable

_A_MOMENT = 0.2  # seconds


def calls_on_ray(
    calls: Callable[[int], dict[Any, tuple[Any, ...]]], jobs: int | None
) -> Iterator[dict[Any, str | None]]:
    """Call functions on the Ray cluster of ``RAY_ADDRESS``, else on a running one, else on a new one on this machine.

    ``calls`` takes the number of calls at once, by default that of GPUs, else of nodes, and returns functions and their
    arguments by name. Repeatedly yields the names of finished calls, each with its return value or its error: the
    reason of a failure, or ``None``.
    """
    try:
        import ray
    except ImportError as error:
        raise InputError("--engine ray: Ray is not installed; run pip install '.[ray]' in a clone") from error

    try:
        ray.init(log_to_driver=False, include_dashboard=False, logging_level="ERROR")
    except Exception as error:  # Ray raises plain exceptions if a machine is too busy
        raise InputError(f"--engine ray: {one_line(error)}") from error
    try:
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        share = _share(nodes, jobs)
        at_once = jobs or int(sum(node.get("GPU", 0) for node in nodes)) or len(nodes)
        remote = ray.remote(max_retries=0, **share)
        running = {remote(call).remote(*given): name for name, (call, *given) in calls(at_once).items()}
        while running:
            done, _ = ray.wait(list(running), timeout=_A_MOMENT)
            yield {running.pop(reference): _outcome(ray, reference) for reference in done}
    finally:
        ray.shutdown()


def _share(nodes: Sequence[dict[str, float]], jobs: int | None) -> dict[str, Any]:
    """Return the resources of one call: a share of the GPUs if the cluster has any, else cores of a node.

    Example:
        >>> _share([{"CPU": 16, "GPU": 2}, {"CPU": 8, "GPU": 2}], None)
        {'num_cpus': 4, 'num_gpus': 1.0}
        >>> _share([{"CPU": 8}], 4)
        {'num_cpus': 2}
    """
    if gpus := sum(node.get("GPU", 0) for node in nodes):
        gpu = min(1.0, gpus / (jobs or gpus))
        cores = min(node["CPU"] / node["GPU"] for node in nodes if node.get("GPU"))
        return {"num_cpus": int(gpu * cores), "num_gpus": gpu}
    on_each = -(-(jobs or len(nodes)) // len(nodes))
    return {"num_cpus": max(1, int(min(node["CPU"] for node in nodes) // on_each))}


def run_to_end(log: Path, words: Sequence[str], there: str) -> str | None:
    """Run Python in a separate process and in a folder, see :func:`start`; return its :func:`exit_reason`."""
    os.chdir(there)
    process = start(log, words, {})
    try:
        return exit_reason(log, process.wait())
    finally:
        stop(process)


def _outcome(ray: Any, reference: Any) -> str | None:
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        return one_line(error.cause)
    except ray.exceptions.RayError as error:
        return f"Ray: {str(error).strip().splitlines()[0]}"


def start(log: Path, words: Sequence[str], environment: dict[str, str]) -> subprocess.Popen:
    """Start Python with additional environment variables, and append its output to a file."""
    # waiting threads that spin would slow down the workers that make clips
    environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, **environment}
    with open(log, "ab") as file:
        return subprocess.Popen(
            [sys.executable, *words],
            stdin=subprocess.PIPE,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=environment,
        )


def stop(process: subprocess.Popen) -> None:
    """End a process of :func:`start`, see :func:`end_with_parent`, and wait for it."""
    process.stdin.close()
    process.wait()


def end_with_parent() -> None:
    """End this process when its parent ends, even if killed: standard input closes then."""

    def wait() -> None:
        while os.read(0, 1):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def exit_reason(log: Path, status: int) -> str | None:
    """Return why a process failed, or ``None`` if it succeeded."""
    if status == 0:
        return None
    if status < 0:
        name = signal.Signals(-status).name
        return f"killed by {name}" + (", perhaps out of memory" if name == "SIGKILL" else "")
    lines = log.read_text(errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), f"status {status}")
    return printable(last.removeprefix("lightning: "))

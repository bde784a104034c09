"""Work in processes of their own, on this machine or on a Ray cluster."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from spikekit.arguments import one_line

#: seconds between two looks at what has ended
A_MOMENT = 0.2


class EngineError(RuntimeError):
    """Ray cannot be started."""


def run_commands_on_ray(
    commands: Callable[[int], dict[Path, Sequence[str]]], jobs: int | None
) -> Iterator[dict[Path, str | None]]:
    """Run Python on a Ray cluster, and say again and again which commands ended, and what went wrong, if anything did.

    It is the cluster that ``RAY_ADDRESS`` names or that runs here, else a Ray of this machine's own.

    Args:
        commands: given how many run at once, the arguments of Python by the file that a command's output goes to.
        jobs: commands at once; as many as there are GPUs, or else nodes, if ``None``.

    Raises:
        EngineError: Ray cannot be started.
    """
    import ray

    try:
        ray.init(log_to_driver=False, include_dashboard=False, logging_level="ERROR")
    except Exception as error:  # Ray raises its plainest kind where a machine is too busy to start it
        raise EngineError(f"--engine ray: {one_line(error)}") from error
    try:
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        share = _share(nodes, jobs)
        at_once = jobs or int(sum(node.get("GPU", 0) for node in nodes)) or len(nodes)
        task = ray.remote(max_retries=0, **share)(_run_to_end)
        running = {task.remote(log, words, os.getcwd()): log for log, words in commands(at_once).items()}
        while running:
            done, _ = ray.wait(list(running), timeout=A_MOMENT)
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
    process = start(log, words, {})
    try:
        return reason(log, process.wait())
    finally:
        stop(process)


def _outcome(ray: Any, reference: Any) -> str | None:
    try:
        return ray.get(reference)
    except ray.exceptions.RayError as error:
        return f"Ray: {str(error).strip().splitlines()[0]}"


def start(log: Path, words: Sequence[str], environment: dict[str, str]) -> subprocess.Popen:
    """Start Python.

    Args:
        log: file that its output is added to.
        words: its arguments.
        environment: variables that differ from those of this process.
    """
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


def stop(process: subprocess.Popen) -> None:
    """End a process that called :func:`end_with_parent`."""
    process.stdin.close()
    process.wait()


def end_with_parent() -> None:
    """Stop where the one that started this process does, even when it is killed: our standard input then closes."""

    def wait() -> None:
        while os.read(0, 1):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def reason(log: Path, status: int) -> str | None:
    """Return what went wrong in a process that ended, ``None`` if nothing did.

    Args:
        log: what it wrote.
        status: its exit status.
    """
    if status == 0:
        return None
    if status < 0:
        name = signal.Signals(-status).name
        return f"killed by {name}" + (", perhaps for want of memory" if name == "SIGKILL" else "")
    lines = log.read_text(errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), f"status {status}")
    return last.removeprefix("lightning: ")

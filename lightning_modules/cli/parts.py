"""Parts of a recording, each made by a process of its own on a Ray cluster."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from lightning_modules.cli.arguments import options
from lightning_modules.cli.errors import InputError, UsageError
from lightning_modules.processes import run_commands_on_ray

_PROCESS = """\
from lightning_modules.processes import end_with_parent
end_with_parent()
from lightning_modules.__main__ import main
main()
"""


def make_parts(typed: Sequence[str], folder: Path, precision: str, jobs: int | None) -> None:
    """Make all pictures of a recording, in as many parts as are made at once.

    Args:
        typed: verb and arguments of ``lightning predict``.
        folder: of the pictures, under the same path for all nodes.
        precision: the same for all of them, whatever each would choose.
        jobs: parts at once; as many as there are GPUs, or else nodes, if ``None``.

    Raises:
        UsageError: a ``--budget``, which every node would measure for itself.
        InputError: Ray is not installed, or a part failed.
    """
    if any(option == "--budget" for _, option, _ in options(typed)):
        raise UsageError("--engine ray: expected --speed or --model.weights, got --budget, which differs by node")
    if find_spec("ray") is None:
        raise InputError("predict: --engine ray: Ray is not installed; pip install '.[ray]' in a clone brings it")
    quiet = ["--engine", "local", "--trainer.enable_progress_bar", "false", "--trainer.precision", precision]
    logs: list[Path] = []

    def commands(count: int) -> dict[Path, list[str]]:
        logs.extend(folder.absolute() / f"part_{n}_of_{count}.log" for n in range(1, count + 1))
        words = ["-c", _PROCESS, *typed, *quiet]
        return {log: [*words, "--part", f"{n}/{count}"] for n, log in enumerate(logs, 1)}

    for ended in run_commands_on_ray(commands, jobs):
        for log, reason in ended.items():
            if reason is not None:
                raise InputError(f"{log}: {reason}")
            print(f"{log.stem.replace('_', ' ')} is made", flush=True)
    for log in logs:
        log.unlink(missing_ok=True)

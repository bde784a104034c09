"""The command ``lightning sweep``."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from lightning_modules.cli.command import check_folder
from lightning_modules.cli.errors import Ended, InputError, UsageError, VerbParser
from lightning_modules.cli.folder_lock import locked_folder
from lightning_modules.cli.processes import calls_on_ray, exit_reason, run_to_end, start, stop
from lightning_modules.configurations import find_configs
from lightning_modules.sweep.state import LOG, PROGRESS, RESULT, read_progress, read_result
from lightning_modules.sweep.table import collect, markdown, write_csv
from lightning_modules.sweep.trials import Trial, make_trials, seconds
from spikekit.arguments import home_path, one_line, positive, whole
from spikekit.io.whole_file import write_whole

_A_MOMENT = 0.2  # seconds between two looks at the trials
_A_WHILE = 60  # seconds between two progress lines of a trial


def parser() -> argparse.ArgumentParser:
    """Return the parser of the verb."""
    made = VerbParser(
        prog="lightning sweep",
        allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Train and test every combination of overlays, values and seeds under the same budget.",
        epilog="""\
A trial is `lightning fit`, then `lightning test` of the last weights, in a separate process on one device. A trial that
fails is reported, and the others continue. All configurations are parsed and built before the first one is trained.
The same command resumes a sweep that was stopped or killed: finished trials are kept, failed ones are repeated, the
others resume from their last checkpoint. A folder that holds a trial with other settings is rejected.

Results: sweep.md and sweep.csv with one row per variant: mean and spread over seeds, and the difference from overlay J
or from the first row. `lightning trade` measures the cost of the variants.

Every trial has its own folder:
  lightning test -c runs/sweep/c-s-seed1/trial.yaml --ckpt_path last

examples:
  lightning sweep x4 -c quick --over 'ablation/*' --seeds 0 1 --steps 300
  lightning sweep x4 --set model.network=CSCSR,BasicVSR,VidarSR --flops 1e16
  lightning sweep x4 --over 'ablation/*' --set model.network.size=small,full_large --time 12:00:00 --engine ray
  lightning sweep configs/x4.yaml --set model.network.width=16,32,64 --set data.root=DIR --flops 1e15
""",
    )
    add = made.add_argument
    add("configs", nargs="*", metavar="CONFIG", help="configuration of all trials, as for lightning fit -c")
    add("-c", "--config", action="append", default=[], metavar="OVERLAY", help="further ones, which override these")
    what = made.add_argument_group("combinations")
    what.add_argument(
        "--over",
        action="append",
        nargs="+",
        default=[],
        metavar="OVERLAY",
        help="group of overlays; each trial takes one of each group; repeatable",
    )
    what.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE,...",
        help="values of an argument of lightning fit; each trial takes one of them",
    )
    what.add_argument(
        "--seeds",
        type=whole(0),
        nargs="+",
        default=[],
        metavar="SEED",
        help="seeds of the initial weights (seed_everything); the clips depend only on data.seed",
    )
    group = made.add_argument_group("budget of each trial; default: that of the configuration")
    budget = group.add_mutually_exclusive_group()
    budget.add_argument("--steps", type=whole(1), help="training steps; a schedule with an end (T_max) ends with them")
    budget.add_argument(
        "--time",
        type=seconds,
        metavar="HH:MM:SS",
        help="wall time of training with validation; a schedule with an end becomes a cosine that ends with it",
    )
    budget.add_argument(
        "--flops",
        type=positive,
        help="floating-point operations of training; the number of steps follows from the FLOPs of one step "
        "(convolutions and matrix products, forward and backward, without elementwise operations and the warp)",
    )
    how = made.add_argument_group("execution")
    how.add_argument(
        "-o", "--output", type=home_path, default=Path("runs/sweep"), metavar="DIR", help="default: runs/sweep"
    )
    how.add_argument(
        "--engine",
        choices=_ENGINES,
        default="local",
        help="local: this machine, one trial after another (default); ray: the Ray cluster of RAY_ADDRESS, or Ray on "
        "this machine, one trial per GPU, or per node without GPUs",
    )
    how.add_argument("--jobs", type=whole(1), metavar="N", help="trials at once; they share cores or GPUs")
    how.add_argument(
        "--every",
        type=positive,
        default=60.0,
        metavar="SECONDS",
        help="time between two checkpoints, besides those after each epoch; default: 60",
    )
    return made


def sweep(args: Sequence[str]) -> None:
    """Run ``lightning sweep`` with the given arguments."""
    asked = parser().parse_args(args)
    configs = [find_configs(name)[0] for name in asked.configs] + asked.config
    over = [[file for name in group for file in find_configs(name)] for group in asked.over]
    if not configs:
        raise UsageError("sweep: expected a configuration, such as x4, got none")
    check_folder(asked.output)
    budget = {"steps": asked.steps, "seconds": asked.time, "flops": asked.flops}
    budget = {name: value for name, value in budget.items() if value is not None}
    trials = make_trials(configs, over, asked.set, asked.seeds, budget, asked.output)
    with locked_folder(asked.output, "sweep"):
        for trial in trials:
            trial.write()
        failed = _run(trials, asked)
    if failed:
        raise InputError(f"sweep: {len(failed)} of {len(trials)} trials failed; the same command repeats them")


def _run(trials: Sequence[Trial], asked: argparse.Namespace) -> dict[Path, str]:
    failed: dict[Path, str] = {}
    waiting = [trial.folder for trial in trials if not (trial.folder / RESULT).is_file()]
    print(f"{asked.output}: {len(trials)} trials, {len(trials) - len(waiting)} of them finished before")
    for folder in waiting:
        (folder / PROGRESS).unlink(missing_ok=True)
    said = dict.fromkeys(waiting, 0.0)
    try:
        for ended in _ENGINES[asked.engine](waiting, asked.jobs, asked.every) if waiting else []:
            for folder, reason in ended.items():
                said.pop(folder)
                result = read_result(folder) if reason is None else None
                if result is None:
                    failed[folder] = one_line(ValueError(reason or "ended without a result"))
                    print(f"{folder.name}  FAILED: {failed[folder]} ({folder / LOG})", flush=True)
                else:
                    scores = ", ".join(f"{name} {value:.4g}" for name, value in result["scores"].items())
                    print(f"{folder.name}  done, {scores}  [{len(said)} of {len(trials)} to go]", flush=True)
                _write_tables(trials, failed, asked)
            for folder in said:
                if time.monotonic() - said[folder] > _A_WHILE and (text := read_progress(folder)):
                    said[folder] = time.monotonic()
                    print(f"{folder.name}  {text}", flush=True)
    except KeyboardInterrupt:
        raise Ended("lightning: sweep: interrupted; the same command resumes it", 130) from None
    print(f"\n{_write_tables(trials, failed, asked)}")
    print(", ".join(str(asked.output / name) for name in ("sweep.csv", "sweep.md")))
    return failed


def _write_tables(trials: Sequence[Trial], failed: dict[Path, str], asked: argparse.Namespace) -> str:
    rows = collect(trials, failed)
    text = markdown(rows)
    write_whole(asked.output / "sweep.md", text)
    write_csv(rows, asked.output / "sweep.csv")
    return text


def run_locally(folders: Sequence[Path], jobs: int | None, every: float) -> Iterator[dict[Path, str | None]]:
    """Run trials on this machine, ``jobs`` at once with a share of the cores; repeatedly yield those that ended.

    Each has the reason of its failure, or ``None``.
    """
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


def run_on_ray(folders: Sequence[Path], jobs: int | None, every: float) -> Iterator[dict[Path, str | None]]:
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


_ENGINES = {"local": run_locally, "ray": run_on_ray}

"""Cost of the variants of a sweep at inference: time, memory and multiplications of a frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lightning_modules.cli.errors import InputError
from lightning_modules.cost.measure import Measurement, measure_costs, quartiles, running
from lightning_modules.cost.runner import CannotRunError, Runner
from lightning_modules.cost.setting import Setting
from lightning_modules.sweep.state import read_json, write_json
from lightning_modules.sweep.table import VariantResults
from spikekit.progress import progress
from spikekit.timing import cpu_name

_ROUNDS = 5


def measure_variants(rows: Sequence[VariantResults], path: Path) -> dict[str, Any]:
    """Measure the cost of ``lightning predict`` on a clip for every trained variant, or read earlier results.

    All variants are measured in this process, with the weights of their first seed, and timed in turns: every variant
    once in every round. One that cannot run here is left out.

    Args:
        rows: of the sweep; those without a result are left out.
        path: where the costs are written, and read where they are those of the same trials.

    Returns:
        ``variants``: by name ``ms``, ``mib`` and ``macs``, the multiplications of a sensor pixel; ``where``: how they
        were measured, a sentence; ``trials``: their folders.
    """
    trials = {
        row.variant: next(trial.folder for trial in row.trials if trial.seed in row.results)
        for row in rows
        if row.results
    }
    names = {variant: folder.name for variant, folder in trials.items()}
    known = read_json(path)
    if known and known["trials"] == names:
        return known
    ready = (_ready(variant, folder) for variant, folder in progress(trials.items(), "variants built"))
    measured = [row for row in ready if row is not None]
    variants, where = {}, ""
    if measured:
        longest = max(measured, key=lambda row: row.runner.network.frames)
        clip = next(iter(longest.runner.data.test_dataloader()))["spikes"][:1]
        timed = measure_costs(measured, [clip], _ROUNDS)
        for row in running(measured):
            ms = 1e3 * quartiles(row.seconds)[1]
            variants[row.setting.name] = {"ms": ms, "mib": row.memory, "macs": row.macs}
        devices = ", ".join(dict.fromkeys(str(row.runner.device) for row in running(measured)))
        size = " x ".join(map(str, timed.size))
        where = f"a clip of {size} sensor pixels, median of {_ROUNDS} turns, {timed.unit} on {devices}, {cpu_name()}"
    found = {"trials": names, "variants": variants, "where": where}
    write_json(path, found)
    return found


def _ready(variant: str, folder: Path) -> Measurement | None:
    args = ["-c", str(folder / "trial.yaml"), "--ckpt_path", str(folder / "checkpoints" / "last.ckpt")]
    try:
        return Measurement(Setting(variant, args), Runner(args))
    except (CannotRunError, InputError):
        return None

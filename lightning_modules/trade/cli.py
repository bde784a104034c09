"""The command ``lightning trade``."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path

from lightning_modules.cli.errors import InputError, UsageError, VerbParser, input_errors
from lightning_modules.cli.folder_lock import locked_folder
from lightning_modules.trade.films import PICTURES, measure_films
from lightning_modules.trade.measure import Measurement, measure, running, single_clips
from lightning_modules.trade.runner import CannotRunError, Runner, make_runner
from lightning_modules.trade.settings import Setting, read_setting, usual_settings
from lightning_modules.trade.table import COLUMNS, markdown, write_csv
from spikekit.arguments import home_path, whole
from spikekit.io.whole_file import write_whole
from spikekit.progress import progress

_OUTPUT, _ROUNDS = Path("runs/trade"), 9


def parser() -> argparse.ArgumentParser:
    """Return the parser of the verb."""
    made = VerbParser(
        prog="lightning trade",
        allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        usage="lightning trade -c CONFIG [-c OVERLAY ...] [arguments of lightning test] [--setting SETTING ...] "
        "[--rounds N] [-o DIR]",
        description="Measure cost and quality of settings on this machine and the test scenes.",
        epilog=f"""\
A setting is a list of arguments of `lightning test`, appended to the shared ones. Its pictures are computed as by
`lightning predict`, with tiles, on the test clips; a network with fewer frames than the clips takes the middle ones.
All settings are parsed and built before the first one runs. A setting that cannot run here, such as with a missing
file, gets a row with the reason; the others are measured. Times are taken in one process, in turns: in every round,
every setting once, on the same clip.

With --film EVERY, the test scenes are films of {PICTURES} pictures, EVERY clocks apart. Time and work are per picture;
PSNR, SSIM and LPIPS leave out the first and the last picture.

Results: trade.md and trade.csv, with the Pareto front of time and PSNR.

columns:
{COLUMNS}

examples:
  lightning trade -c configs/x4.yaml --film 20
  lightning trade -c configs/x4.yaml --setting "--model.weights cscsr_small_x4" --setting "-c my.yaml --ckpt_path FILE"
""",
    )
    add = made.add_argument
    add(
        "--setting",
        action="append",
        default=[],
        metavar="SETTING",
        help="'ARGS' or 'NAME: ARGS', repeatable; default: the networks of the package, or that of --ckpt_path or "
        "--model.weights; variants of the first network; the decoders",
    )
    add("--rounds", type=whole(1), default=_ROUNDS, metavar="N", help=f"timings of every setting; default: {_ROUNDS}")
    add("--film", type=whole(1), metavar="EVERY", help="measure films with one picture every EVERY clocks")
    add("-o", "--output", type=home_path, default=_OUTPUT, metavar="DIR", help=f"default: {_OUTPUT}")
    return made


def trade(args: Sequence[str]) -> None:
    """Run ``lightning trade`` with the given arguments."""
    asked, shared = parser().parse_known_args(args)
    given = [read_setting(text) for text in asked.setting]
    try:
        base = Runner(shared)
    except CannotRunError as error:
        raise InputError(f"trade: {error}") from error
    weights = base.config["model"]["init_args"].get("weights")
    options = {"--ckpt_path": base.config["ckpt_path"], "--model.weights": weights}
    own = [option for option, value in options.items() if value is not None]
    network, film = base.network, asked.film is not None
    usual = usual_settings(network.scale, own, network if own else None, film, network.frames, network.pattern)
    settings = given or usual
    names = [setting.name for setting in settings]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UsageError(f"trade: two settings have the name {twice!r}; name them with 'NAME: ARGS'")
    rows = [_row(setting, shared, base) for setting in progress(settings, "settings built")]
    _check_any(rows)
    with locked_folder(asked.output, "lightning trade"):
        _measured(rows, base, asked, shlex.join(["lightning", "trade", *args]))


def _measured(rows: Sequence[Measurement], base: Runner, asked: argparse.Namespace, command: str) -> None:
    """Measure the rows, then print and write the tables."""
    for row in rows:
        if row.reason is not None:
            print(f"{row.setting.name} cannot run: {row.reason}", flush=True)
    if asked.film is None:
        timed = measure(rows, single_clips(base.data.test_dataloader()), asked.rounds)
    else:
        with input_errors():
            timed = measure_films(rows, base.data, base.network.frames, asked.film, asked.rounds)
    _check_any(rows)
    text = markdown(rows, command, timed)
    write_whole(asked.output / "trade.md", text)
    write_csv(rows, timed, asked.output / "trade.csv")
    print(f"\n{text}")
    print(", ".join(str(path) for path in (asked.output / "trade.csv", asked.output / "trade.md")))


def _row(setting: Setting, shared: Sequence[str], base: Runner) -> Measurement:
    try:
        return Measurement(setting, make_runner(shared, setting.args, base))
    except InputError as error:
        raise type(error)(f"{setting.name}: {error}") from error
    except CannotRunError as error:
        return Measurement(setting, reason=str(error))


def _check_any(rows: Sequence[Measurement]) -> None:
    if not running(rows):
        raise InputError(f"trade: no setting can run; {rows[0].setting.name}: {rows[0].reason}")

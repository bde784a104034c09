"""The command ``lightning export``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lightning_modules.cli.errors import InputError, VerbParser
from lightning_modules.motion import ESTIMATORS
from lightning_modules.networks import NETWORKS
from lightning_modules.pretrained import check_weights, read_weights, write_weights


def export(args: Sequence[str]) -> None:
    """Write the weights of a checkpoint as a file of safetensors.

    Args:
        args: what was typed after ``lightning export``.

    Raises:
        InputError: no such checkpoint, or a damaged one; or a name of another kind of file.
    """
    parser = VerbParser(
        prog="lightning export",
        description="Write the weights of a checkpoint as a file of safetensors that knows what network it is of, for "
        "lightning predict --model.weights FILE and CSCSR.from_pretrained(FILE).",
    )
    parser.add_argument("checkpoint", help="checkpoint of lightning fit")
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="name.safetensors")
    asked = parser.parse_args(args)
    try:
        weights = read_weights(asked.checkpoint)
        check_weights(weights, {**NETWORKS, **ESTIMATORS})
        write_weights(weights, asked.output)
    except (OSError, ValueError) as error:
        raise InputError(str(error)) from error
    print(f"{asked.output}: {Path(asked.output).stat().st_size / 2**20:.1f} MiB")

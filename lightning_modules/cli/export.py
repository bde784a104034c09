"""The command ``lightning export``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

from lightning_modules.cli.configured import configured_network
from lightning_modules.cli.errors import InputError, VerbParser, input_errors
from lightning_modules.inference.export import FORMATS, export_network
from lightning_modules.motion import ESTIMATORS
from lightning_modules.networks import NETWORKS
from lightning_modules.storage.pretrained import (
    Weights,
    check_weights,
    motion_of,
    read_weights,
    settings_of,
    write_weights,
)
from spikekit.arguments import home_path
from spikekit.timing import duration


def parser() -> argparse.ArgumentParser:
    """Return the parser of the verb."""
    made = VerbParser(
        prog="lightning export",
        description="Export a network for other programs. safetensors: weights with the settings of their network, "
        "for lightning predict --weights FILE and CSCSR.from_pretrained(FILE). torch: a program of torch.export, which "
        "needs only torch. onnx: for onnxruntime and others (needs the extra 'export'). Programs take a clip of any "
        "even height and width; a network that follows motion takes the flow as a second input, as motion estimation "
        "cannot be exported. Programs are compared with the network on three sizes.",
    )
    made.add_argument("weights", help="name listed by lightning models, .safetensors file or checkpoint")
    made.add_argument(
        "-c", "--config", action="append", default=[], metavar="FILE", help="configuration of your own network"
    )
    made.add_argument("--format", choices=("safetensors", *FORMATS), default="safetensors", help="default: safetensors")
    made.add_argument("--still", action="store_true", help="nothing moves: no flow input (torch, onnx)")
    made.add_argument("-o", "--output", type=home_path, required=True, metavar="OUT", help=".safetensors, .pt2, .onnx")
    return made


def export(args: Sequence[str]) -> None:
    """Run ``lightning export`` with the given arguments."""
    asked = parser().parse_args(args)
    begin = perf_counter()
    ending = FORMATS.get(asked.format, ".safetensors")
    if asked.output.suffix != ending:
        raise InputError(f"-o: expected a file name ending in {ending} for {asked.format}, got {asked.output}")
    said = ""
    with input_errors():
        if asked.format in FORMATS:
            network = configured_network(asked.config, asked.weights)
            said = f", {export_network(network, asked.output, asked.format, still=asked.still)}"
        else:
            write_weights(_weights(asked), asked.output)
    size = asked.output.stat().st_size / 2**20
    print(f"{asked.output}: {size:.1f} MiB{said}, in {duration(perf_counter() - begin)}")


def _weights(asked: argparse.Namespace) -> Weights:
    if asked.config:
        network = configured_network(asked.config, asked.weights)
        return Weights(Path(asked.weights), settings_of(network), motion_of(network), network.state_dict())
    weights = read_weights(asked.weights)
    check_weights(weights, {**NETWORKS, **ESTIMATORS})
    return weights

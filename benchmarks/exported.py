"""The cost of exported networks compared with the network itself: ``python benchmarks/exported.py WEIGHTS``."""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from in_turn import interleave, ratio

from lightning_modules.inference.export import (
    FORMATS,
    OPSET,
    as_exported,
    difference,
    example_inputs,
    export_network,
    exported,
)
from lightning_modules.networks import Network
from spikekit.arguments import whole
from spikekit.tables import table
from spikekit.timing import cpu_name, timer_of


def main(args: Sequence[str] | None = None) -> None:
    """Print size, difference and relative time of every format, timed in turn in one process and thread."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("weights", nargs="+", help="names or files of weights")
    size = "height and width of the clip, in sensor pixels; default: 96 96"
    parser.add_argument("--size", nargs=2, type=whole(16), default=[96, 96], metavar=("H", "W"), help=size)
    parser.add_argument("--rounds", type=whole(1), default=5, help="timings of each; default: 5")
    parser.add_argument("--formats", nargs="+", choices=FORMATS, default=list(FORMATS), help="default: all")
    asked = parser.parse_args(args)
    torch.set_num_threads(1)
    rows = [row for name in asked.weights for row in _rows(name, asked.formats, asked.size, asked.rounds)]
    heading = ["weights", "format", "MiB", "export (s)", "largest difference", "time, network = 1", "ms"]
    print(table(heading, rows))
    height, width = asked.size
    print(f"{height} x {width} sensor pixels, seed 0, {asked.rounds} rounds, one thread of {cpu_name()}")
    print(f"torch {torch.__version__}, ONNX opset {OPSET}")


@torch.no_grad()
def _rows(name: str, formats: Sequence[str], size: Sequence[int], rounds: int) -> list[list[str]]:
    network = Network.from_pretrained(name)
    module, inputs = as_exported(network), list(example_inputs(network, tuple(size)).values())

    def in_bfloat16() -> object:
        with torch.autocast("cpu", torch.bfloat16):
            return module(*inputs)

    runs, cells = {"network": lambda: module(*inputs), "in bfloat16": in_bfloat16}, {"in bfloat16": [""] * 3}
    with tempfile.TemporaryDirectory() as folder:
        for kind in formats:
            path, begin = Path(folder, f"network{FORMATS[kind]}"), time.process_time()
            export_network(network, path, kind)
            took, data = time.process_time() - begin, path.read_bytes()
            run = exported(data, kind, threads=1)
            worst = difference(run(*inputs), module(*inputs)).item()
            cells[kind] = [f"{len(data) / 2**20:.1f}", f"{took:.0f}", f"{worst:.1g}"]
            runs[kind] = lambda run=run: run(*inputs)
        times = interleave(runs, rounds, timer_of(torch.device("cpu"), 1)[0])
    found = [[name, "network", "", "", "", "1", f"{1e3 * min(times['network']):.0f}"]]
    for kind in list(runs)[1:]:
        compared = ratio(times[kind], times["network"])
        said = f"{compared.median:.2f} ({compared.least:.2f} .. {compared.most:.2f})"
        found.append([name, kind, *cells[kind], said, f"{1e3 * min(times[kind]):.0f}"])
    return found


if __name__ == "__main__":
    main()

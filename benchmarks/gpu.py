"""Throughput of a GPU: scenes, motion, training, pictures and films, compared with its limits.

    python benchmarks/gpu.py [PICTURES] [--short]

Takes at most five minutes, and writes rows to results/gpu.csv as they are measured. The limit of a task is the time of
its necessary memory traffic or multiplications, at the measured rates of a copy and a matrix product. ``--short`` runs
everything once on small sizes, on any device.
"""

from __future__ import annotations

import argparse
import csv
import platform
import sys
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from lightning_modules.data.pictures import embedded_pictures, folder_pictures
from lightning_modules.data.rendering import Gallery
from lightning_modules.data.stills import StillClips
from lightning_modules.motion import ClassicalFlow
from lightning_modules.networks import CSCSR, RecurrentCSCSR
from lightning_modules.registry import list_models
from lightning_modules.tasks.muon import MuonWithAdam
from spikekit import spike_integrate_fire, tfi, tfp

RESULTS = Path(__file__).parents[1] / "results" / "gpu.csv"
COLUMNS = ("what", "shape", "seconds", "rate", "unit", "limit", "card", "torch", "date")
KINDS = {"clips": {}, "films of 5, every 8": {"key_frames": 5, "every": 8, "motion": 6.0, "bend": 1.2}}

Row = tuple[str, str, Callable[[], object], float, str, float]  # task, shape, work, number of units, unit, limit in s


def seconds(work: Callable[[], object], device: torch.device, most: float) -> float:
    """Return the median time of some work, repeated as often as time allows."""

    def once() -> float:
        start = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter() - start

    first = [once() for _ in range(1 if most <= 0 else 2)]
    left, took = most - sum(first), []
    while left > 0 and len(took) < 50:
        took.append(once())
        left -= took[-1]
    return float(np.median(took or first[-1:]))


def scenes(pictures: list[Path], count: int, patch: int, device: torch.device, bytes_s: float) -> Iterator[Row]:
    """Return rows for scenes of both kinds, rendered in parts as in training."""
    for kind, options in KINDS.items():
        clips = StillClips(pictures, scale=4, patch=patch, **options)
        gallery = clips.sources.gallery(device)
        scenes = max(1, count // clips.key_frames)
        drawn = [clips.draw(index) for index in range(min(scenes, 64))]
        drawn = {name: np.stack([one[name] for one in drawn]) for name in drawn[0]}
        parts = max(1, scenes // len(drawn["picture"]))

        start = time.perf_counter()
        for index in range(20):
            clips.draw(index)
        own = (time.perf_counter() - start) / 20
        made = parts * len(drawn["picture"])
        # positions of the background at every clock, written and read, and the values there
        limit = made * clips.clocks * (4 * patch) ** 2 * (2 * 8 + 2 * 4) / bytes_s
        shape = f"{made} of {patch} x {patch}, drawn in {1e6 * own:.0f} us each by one core"
        work = partial(render, clips, drawn, gallery, parts)
        yield f"scenes, {kind}", shape, work, made * clips.key_frames, "clips", limit


def render(clips: StillClips, drawn: dict[str, np.ndarray], gallery: Gallery, parts: int) -> None:
    """Make clips."""
    for _ in range(parts):
        clips.render(drawn, gallery)


def motion(sizes: list[tuple[int, int, int]], device: torch.device) -> Iterator[Row]:
    """Return rows for ClassicalFlow of batches of clips."""
    for count, height, width in sizes:
        spikes = (torch.rand(count, 41, height, width, device=device) < 0.2).to(torch.uint8)
        work = partial(ClassicalFlow(), spikes, (5, 20, 35), "RGGB")
        yield "motion", f"{count} of {height} x {width}", work, count, "clips", float("nan")


def training(names: list[str], batches: list[int], patch: int, device: torch.device, flops: float) -> Iterator[Row]:
    """Return rows for training steps of Muon on given batches: single clips, and films of 5."""
    macs = {model.name: model.macs for model in list_models()}
    for name in names:
        network = CSCSR.from_pretrained(name).to(device).train().to(memory_format=torch.channels_last)
        optimizer = MuonWithAdam(network.parameters(), lr=1e-4)
        for batch in batches:
            for keys in (1, 5) if isinstance(network, RecurrentCSCSR) else (1,):
                shape = (max(batch // keys, 1), keys) if keys > 1 else (batch,)
                spikes = (torch.rand(*shape, network.frames, patch, patch, device=device) < 0.2).to(torch.uint8)
                side = network.scale * patch
                rgb, flow = torch.rand(*shape, 3, side, side, device=device), torch.zeros(*shape, 2, 2, patch, patch)

                clips = rgb.shape[:-3].numel()
                limit = clips * patch**2 * macs[name] * 2 * 3 / flops
                what = f"training, {name}{', films of 5' if keys > 1 else ''}"
                work = partial(step, network, optimizer, spikes, flow.to(device), rgb)
                yield what, f"{clips} clips", work, clips, "clips", limit


def step(network: CSCSR, optimizer: MuonWithAdam, *batch: torch.Tensor) -> None:
    """A step of training."""
    spikes, flow, rgb = batch
    with torch.autocast(rgb.device.type, torch.bfloat16):
        seen = network.film(spikes, flow, every=8, future=4) if spikes.ndim == 5 else [network(spikes, flow)]
        loss = sum(F.l1_loss(one, rgb) for one in seen)
    loss.backward()
    optimizer.step()
    optimizer.zero_grad()


def pictures(names: list[str], sizes: list[tuple[int, int]], device: torch.device, flops: float) -> Iterator[Row]:
    """Return rows for pictures in bfloat16: the network alone, with motion, and in a film of 5."""
    for model in (model for model in list_models() if model.name in names):
        network = CSCSR.from_pretrained(model.name).to(device).to(memory_format=torch.channels_last)
        for height, width in sizes:
            spikes = (torch.rand(1, network.frames, height, width, device=device) < 0.2).to(torch.uint8)
            flow = torch.zeros(1, 2, 2, height, width, device=device)
            limit = height * width * model.macs * 2 / flops

            shape = f"{height} x {width}"
            yield f"network, {model.name}", shape, partial(run, network, spikes, flow), 1, "pictures", limit
            keys = 5 if isinstance(network, RecurrentCSCSR) else 1
            what = f"motion and network, {'film of ' * (keys > 1)}{model.name}"
            clips = spikes[:, None].repeat(1, keys, 1, 1, 1) if keys > 1 else spikes
            yield what, shape, partial(run, network, clips), keys, "pictures", keys * limit


def run(network: CSCSR, *inputs: torch.Tensor) -> None:
    """Make pictures."""
    with torch.inference_mode(), torch.autocast(inputs[0].device.type, torch.bfloat16):
        network(*inputs)


def sensor(shape: tuple[int, int, int], device: torch.device, bytes_s: float) -> Iterator[Row]:
    """Return rows for the simulator's kernel and the decoders."""
    light = torch.rand(*shape, device=device) * 0.4
    charge = torch.zeros(shape[1:], device=device)
    spikes, _ = spike_integrate_fire(light, 1.0, charge, dtype=torch.uint8)
    size, named = light.numel(), " x ".join(map(str, shape))
    for what, work, through in (
        ("integrate and fire", lambda: spike_integrate_fire(light, 1.0, charge, dtype=torch.uint8), 5),
        ("tfi", lambda: tfi(spikes), 5),
        ("tfp, window 11", lambda: tfp(spikes, 11), 5),
    ):
        yield what, named, work, shape[0], "frames", size * through / bytes_s


def roofs(device: torch.device, size: int) -> tuple[float, float]:
    """Return the bytes per second of a copy, and the operations per second of a matrix product in bfloat16."""
    matrix = torch.rand(size, size, device=device)
    copied, small = torch.empty_like(matrix), matrix.bfloat16()
    most = 0.5 if size > 1024 else 0.0
    rate = 2 * matrix.nbytes / seconds(lambda: copied.copy_(matrix), device, most)
    return rate, 2 * size**3 / seconds(lambda: small @ small, device, most)


def main() -> None:
    """Measure, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pictures", nargs="?", type=Path, help="folder; default: pictures of scikit-image")
    parser.add_argument("--short", action="store_true")
    parser.add_argument("--minutes", type=float, default=5.0, help="time limit; default: 5")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    args = parser.parse_args()
    device, start = torch.device("cuda" if torch.cuda.is_available() else "cpu"), time.monotonic()
    card = torch.cuda.get_device_name() if device.type == "cuda" else platform.processor() or platform.machine()
    bytes_s, flops = roofs(device, 256 if args.short else 8192)
    found = folder_pictures(args.pictures)[:64] if args.pictures else embedded_pictures()
    best = ["cscsr_small_x4", "cscsr_huge_x4"]
    if args.short:
        rows = [
            scenes(found[:2], 4, 8, device, bytes_s), motion([(2, 16, 16)], device),
            sensor((4, 8, 8), device, bytes_s), pictures(["cscsr_tiny_x4"], [(16, 16)], device, flops),
            training(["cscsr_small_x4"], [5], 8, device, flops),
        ]  # fmt: skip
    else:
        rows = [
            scenes(found, 960, 48, device, bytes_s),
            motion([(1, 250, 400), (960, 48, 48), (1, 1000, 1000)], device),
            sensor((200, 1000, 1000), device, bytes_s), training(best, [48, 240, 480], 48, device, flops),
            pictures([*best, "cscsr_tiny_x4"], [(250, 400), (1000, 1000)], device, flops),
        ]  # fmt: skip
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with open(args.output, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        about = card, f"torch {torch.__version__}", datetime.now(UTC).date().isoformat()

        def write(what: str, shape: str, took: float, rate: float, unit: str, limit: float) -> None:
            writer.writerow([what, shape, f"{took:.6f}", f"{rate:.1f}", unit, f"{limit:.6f}", *about])
            file.flush()
            sys.stdout.write(
                f"{what}, {shape}: {1000 * took:.2f} ms, {rate:.1f} {unit}/s, limit {1000 * limit:.3f} ms\n"
            )
            sys.stdout.flush()

        write("copy", "", 1.0, bytes_s / 1e9, "GB", 1.0)
        write("matrix product, bfloat16", "", 1.0, flops / 1e12, "TFLOP", 1.0)
        for group in rows:
            for what, shape, work, units, unit, limit in group:
                if time.monotonic() - start > 60 * args.minutes:
                    return
                try:
                    took = seconds(work, device, 0.0 if args.short else 2.0)
                except RuntimeError as error:  # such as out of memory, which is a result, too
                    took, shape = float("inf"), f"{shape}: {str(error).splitlines()[0]}"
                write(what, shape, took, units / took, unit, limit)


if __name__ == "__main__":
    main()

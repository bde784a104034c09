"""Measure the savings and costs of adaptive sampling on scenes of known light.

``python benchmarks/adaptive_sampling.py`` prints the table.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.color.demosaic import demosaic
from spikekit.decoders.dense import tfi, tfp
from spikekit.metrics import psnr
from spikekit.scenes.adaptive_sampling import Plan
from spikekit.scenes.analytic import Layer, Motion, Scene
from spikekit.scenes.frame_sequence import FrameSequence
from spikekit.sensor.simulate import simulate_spikes
from spikekit.tables import table
from spikekit.timing import peak_memory

CLOCKS, FRAMES = 20, 41
_MOST = Plan.everything(CLOCKS)
_LEGEND = """three frames of a scene whose light is known.
Pairs and triples are: as planned / every clock modelled / from the scene's own light. Time is that of the process.
Spikes: bits that differ, per spike; those of the plan from those with every clock modelled, and both from the truth's.
"""


def drawing(height: int, width: int, seed: int) -> Tensor:
    """Draw a picture with a natural spectrum, from soft shades to fine grain, and discs with sharp edges.

    Returns:
        ``rgb`` of shape (3, height, width), float32, in [0, 1].
    """
    generator = torch.Generator().manual_seed(seed)
    rows, columns = torch.fft.fftfreq(height)[:, None], torch.fft.rfftfreq(width)
    spectrum = torch.fft.rfft2(torch.randn(3, height, width, generator=generator))
    shades = torch.fft.irfft2(
        spectrum / (rows.square() + columns.square()).sqrt().clamp(min=1 / width), (height, width)
    )
    rgb = (0.5 + 0.2 * shades / shades.std()).clamp(0, 1)
    y, x = torch.arange(height)[:, None], torch.arange(width)
    for _ in range(12):
        top, left, size, *colour = torch.rand(6, generator=generator).tolist()
        disc = (y - top * height) ** 2 + (x - left * width) ** 2 < (4 + size * height / 8) ** 2
        rgb = torch.where(disc, torch.tensor(colour)[:, None, None], rgb)
    return rgb


def scenes(side: int, scale: int) -> Iterator[tuple[str, Callable[[int], Scene], list[float]]]:
    """Yield a name, a scene of ``side`` x ``side`` sensor pixels and the exposures of its three frames.

    Speeds are in sensor pixels per clock.
    """
    view, margin = side * scale, 8 * scale * side // 32

    def scene(
        speed: float, shades: tuple[float, float] = (0, 1), turn: float = 0.0, ball: float | None = None
    ) -> Scene:
        middle = (view - 1) / 2, (view - 1) / 2
        motion = Motion((speed * scale, speed * scale / 4), turn, 1.0, middle)
        picture = torch.lerp(*torch.tensor(shades, dtype=torch.float), drawing(view + 2 * margin, view + 2 * margin, 1))
        layers = [Layer(picture, motion, (-margin, -margin))]
        if ball is not None:
            size = view // 4
            y, x = torch.arange(size)[:, None], torch.arange(size)
            mask = (((y - size / 2) ** 2 + (x - size / 2) ** 2) < (size / 2 - 1) ** 2).float()
            moves = Motion((ball * scale, 0.0))
            layers.append(Layer(drawing(size, size, 2), moves, (3 * size // 2, 3 * size // 2), mask))
        return Scene(layers, view, view, FRAMES)

    steady = [1.0, 1.0, 1.0]
    yield "static", scene(0.0), steady
    yield "flickering", scene(0.0), [0.8, 1.0, 0.85]
    yield "object alone", scene(0.0, ball=0.1), steady
    yield "slow", scene(0.005), steady
    yield "medium", scene(0.05), steady
    yield "fast", scene(0.25), steady
    yield "fast, turning", scene(0.1, turn=0.004, ball=-0.1), steady
    yield "dark", scene(0.05, shades=(0, 0.05)), steady
    yield "bright", scene(0.05, shades=(0.6, 1)), steady


@dataclass(frozen=True)
class Row:
    """A scene, simulated by its plans and with every clock modelled ("everything").

    Attributes:
        scene: name of the scene.
        plan: plan of its first interval.
        seconds: process time for the light of a clip: planned, everything.
        memory: peak memory in MiB: planned, everything.
        changed: bits that differ between the two streams, per spike.
        changed_truth: bits that differ from the exact stream, per spike: planned, everything.
        decibels: PSNR of TFI and TFP of the middle frame: planned, everything, exact.
    """

    scene: str
    plan: Plan
    seconds: tuple[float, float]
    memory: tuple[float | None, float | None]
    changed: float
    changed_truth: tuple[float, float]
    decibels: tuple[tuple[float, ...], tuple[float, ...]]


def measure(
    name: str, scene: Scene, exposures: Sequence[float], scale: int, *, rounds: int = 2, **settings: Any
) -> Row:
    """Simulate a scene from three of its frames and compare the result with the scene's own light."""
    alpha = 0.4
    frames = [scene.rgb(n * CLOCKS) * exposure for n, exposure in enumerate(exposures)]
    truth = scene.light("RGGB", scale=scale, alpha=alpha)
    first, middle, last = exposures
    ramp = torch.cat([torch.linspace(first, middle, CLOCKS + 1), torch.linspace(middle, last, CLOCKS + 1)[1:]])
    truth = truth * ramp[:, None, None]

    def film(plan: Plan | None) -> FrameSequence:
        return FrameSequence(frames, scale=scale, alpha=alpha, clocks=CLOCKS, plan=plan, **settings)

    plans = None, _MOST
    timed = [[_timed(lambda plan=plan: film(plan).light()) for _ in range(rounds)] for plan in plans]
    lights = [runs[0][1] for runs in timed]
    seconds = tuple(min(taken for taken, _ in runs) for runs in timed)
    memory = tuple(peak_memory(lambda plan=plan: film(plan).light(), torch.device("cpu")) for plan in plans)
    # average over several random initial charges
    draws = 4
    spikes = [
        simulate_spikes(light.expand(draws, *light.shape), generator=torch.Generator().manual_seed(0))
        for light in (*lights, truth)
    ]

    def changed(one: Tensor, other: Tensor) -> float:
        return (one != other).sum().item() / other.sum().item()

    decibels = []
    for decode in (tfi, lambda stream: tfp(stream, FRAMES)):
        raws = [decode(stream)[:, FRAMES // 2].float() / alpha for stream in spikes]
        pictures = [F.interpolate(demosaic(raw), scale_factor=scale, mode="bicubic") for raw in raws]
        decibels.append(tuple(psnr(rgb, frames[1].expand_as(rgb)).mean().item() for rgb in pictures))
    return Row(
        name,
        film(None).plan(0),
        seconds,
        memory,
        changed(spikes[0], spikes[1]),
        (changed(spikes[0], spikes[2]), changed(spikes[1], spikes[2])),
        tuple(decibels),
    )


def _timed(run: Callable[[], Tensor]) -> tuple[float, Tensor]:
    begin = time.process_time()
    result = run()
    return time.process_time() - begin, result


def markdown(rows: Iterable[Row]) -> str:
    """Return the table as Markdown."""
    heading = ["scene", "latent frames", "time", "memory, MiB", "spikes changed", "off the truth", "TFI, dB", "TFP, dB"]
    lines = []
    for row in rows:
        region = f" in {row.plan.region[2]} x {row.plan.region[3]}" if row.plan.region else ""
        lines.append(
            [
                row.scene,
                f"{row.plan.latent}{region}",
                f"{row.seconds[0]:.3f} s of {row.seconds[1]:.3f} s, {row.seconds[0] / row.seconds[1]:.0%}",
                " / ".join("-" if peak is None else f"{peak:.0f}" for peak in row.memory),
                f"{row.changed:.2%}",
                f"{row.changed_truth[0]:.1%} / {row.changed_truth[1]:.1%}",
                *(" / ".join(f"{value:.2f}" for value in decoder) for decoder in row.decibels),
            ]
        )
    return table(heading, lines)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add = parser.add_argument
    add("--side", type=int, default=64, help="rows and columns of the sensor")
    add("--scale", type=int, default=4, help="width of a sensor pixel in pixels of a frame")
    add("--spike-tolerance", type=float, default=0.05, help="share of the spikes that may change")
    add("--step", type=float, default=0.5, help="sensor pixels between latent frames")
    add("--rounds", type=int, default=2, help="timings of each, of which the smallest is reported")


def run(args: argparse.Namespace) -> None:
    """Print the table."""
    settings = {"rounds": args.rounds, "spike_tolerance": args.spike_tolerance, "step": args.step}
    measured = [measure(*each, args.scale, **settings) for each in scenes(args.side, args.scale)]
    title = f"{args.side} x {args.side} sensor pixels, x{args.scale}, {FRAMES} clocks, {CLOCKS} an interval, of "
    print(f"{title}{_LEGEND}\n{markdown(measured)}")


if __name__ == "__main__":
    _parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(_parser)
    run(_parser.parse_args())

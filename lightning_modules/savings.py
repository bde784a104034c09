"""What a tolerance saves and what it costs: scenes whose truth is known, reconstructed with and without it.

``python -m lightning_modules.savings WEIGHTS`` prints the table.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from functools import partial

import torch
from torch import Tensor

from lightning_modules.data.pictures import cached_picture, embedded_pictures, folder_pictures
from lightning_modules.look import look, required
from lightning_modules.networks import CSCSR, Network
from lightning_modules.tiles import forward_in_tiles
from spikekit import psnr
from spikekit.arguments import whole
from spikekit.bench.measure import interleave, ratio, timer_of
from spikekit.scene import Layer, Motion, Scene
from spikekit.simulate import simulate_spikes

TOLERANCES = 0.05, 0.1, 0.5, 1.0
_LEGEND = """time: as a share of that without a tolerance (least to most of {rounds} rounds; {timer}).
network, motion: share of the cells that get them. look: share of the time that is spent on looking.
loss: fall of the PSNR against the truth, in dB; it should stay below the tolerance.
"""


def scenes(ground: Tensor, thing: Tensor, height: int, width: int, scale: int) -> Iterator[tuple[str, Scene]]:
    """Yield three scenes of so many sensor pixels and their names: still, mixed, fast.

    Args:
        ground: ``rgb`` of the background, mirrored where it ends.
        thing: ``rgb`` of the object that moves over a still background, by 3 sensor pixels to the last time point.
        height: rows of the sensor.
        width: columns of the sensor.
        scale: how many view pixels a sensor pixel is wide.
    """
    side = scale * min(height, width) // 4
    thing = thing[:, :side, :side]
    y, x = (torch.linspace(-1, 1, length) for length in thing.shape[1:])
    disc = (y[:, None].square() + x.square() <= 1).to(thing)
    position = scale * width // 3, scale * height // 3
    moving = Layer(thing, Motion(velocity=(0.2 * scale, 0.1 * scale)), position, disc)
    view = scale * height, scale * width
    yield "still", Scene([Layer(ground)], *view)
    yield "mixed", Scene([Layer(ground), moving], *view)
    yield "fast", Scene([Layer(ground, Motion(velocity=(0.4 * scale, 0.2 * scale)))], *view)


def rows(
    network: Network, scene: Scene, tolerances: Sequence[float], tile: int, rounds: int
) -> Iterator[tuple[float, ...]]:
    """Yield tolerance, time (median, least and most), network, motion, look and loss; the legend says what they are."""
    settings = network.settings
    light = scene.light(network.pattern, scale=network.scale, alpha=settings["alpha"])
    spikes = simulate_spikes(light, generator=torch.Generator().manual_seed(0))[None]
    truth = scene.rgb(scene.middle)[None]
    seeing = partial(look, spikes, network.scale, network.pattern, settings["alpha"])
    runs = {value: partial(forward_in_tiles, network, spikes, tile, value) for value in (0.0, *tolerances)}
    timer, _ = timer_of(spikes.device, torch.get_num_threads())
    times = interleave({**runs, -1.0: seeing}, rounds, timer)
    best = psnr(runs[0.0]().clamp(0, 1), truth).item()
    for value in tolerances:
        cells = (part.float().mean().item() for part in required(seeing(), value))
        loss = best - psnr(runs[value]().clamp(0, 1), truth).item()
        yield value, *ratio(times[value], times[0.0]), *cells, ratio(times[-1.0], times[value]).median, loss


def _tile(text: str) -> int:
    side = whole(0)(text)
    if side % 2:
        raise argparse.ArgumentTypeError(f"expected an even number of sensor pixels, or 0 for no tiles, got {text}")
    return side


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m lightning_modules.savings", description=__doc__)
    parser.add_argument("weights", help="those of CSCSR: a name, a file of safetensors or a checkpoint")
    parser.add_argument("--pictures", help="folder of pictures; without it, held-out ones of scikit-image")
    parser.add_argument("--height", type=int, default=250, help="sensor rows")
    parser.add_argument("--width", type=int, default=400, help="sensor columns")
    parser.add_argument("--tile", type=_tile, default=128, help="as of lightning predict")
    parser.add_argument("--rounds", type=int, default=3, help="timings of each")
    parser.add_argument("--tolerances", type=float, nargs="+", default=TOLERANCES, metavar="DB")
    args = parser.parse_args(arguments)
    network = CSCSR.from_pretrained(args.weights)
    pictures = embedded_pictures(held_out=True) if args.pictures is None else folder_pictures(args.pictures)
    ground, thing = (cached_picture(pictures[i % len(pictures)]) for i in (0, 1))
    _, timer = timer_of(torch.device("cpu"), torch.get_num_threads())
    print(_LEGEND.format(rounds=args.rounds, timer=timer))  # noqa: T201
    print("| scene | tolerance | time | network | motion | look | loss |\n|---|---|---|---|---|---|---|")  # noqa: T201
    for name, scene in scenes(ground, thing, args.height, args.width, network.scale):
        for value, median, least, most, some, moving, seen, loss in rows(
            network, scene, args.tolerances, args.tile, args.rounds
        ):
            shares = f"{median:.2f} ({least:.2f} to {most:.2f}) | {some:.0%} | {moving:.0%} | {seen:.1%}"
            print(f"| {name} | {value:g} | {shares} | {loss:.3f} |")  # noqa: T201


if __name__ == "__main__":
    main()

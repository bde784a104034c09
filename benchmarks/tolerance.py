"""Measure what a tolerance saves and costs, on scenes whose ground truth is known.

``python benchmarks/tolerance.py WEIGHTS`` prints the table; with ``--fit`` it fits what the tolerance is
kept by, the constants of ``WEIGHTS``, writes them beside the weights, and prints what held-out clips lose; with
``--halo`` it prints how far around a tile their networks see.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from statistics import mean

import tolerance_fit
import torch
from in_turn import interleave, ratio
from tolerance_fit import Clip, Errors, fit_error_model, loss, make_clips, measure_errors
from torch import Tensor

from lightning_modules.data.pictures import embedded_pictures, folder_pictures, split_pictures
from lightning_modules.inference.scene_activity import expected_errors, moving_cells, scene_activity
from lightning_modules.inference.tiles import forward_in_tiles
from lightning_modules.networks import CSCSR, Network
from lightning_modules.storage.error_model import write_error_model
from lightning_modules.storage.pretrained import read_weights
from spikekit import psnr, read_picture
from spikekit.arguments import whole
from spikekit.scenes.analytic import Layer, Motion, Scene
from spikekit.sensor.simulate import simulate_spikes
from spikekit.timing import timer_of

TOLERANCES = 0.05, 0.1, 0.5, 1.0
_LEGEND = """time: as a share of that without a tolerance (least to most of {rounds} rounds; {timer}).
motion: share of the cells that get it. look: share of the time that is spent on looking.
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
    """Yield tolerance, time (median, least and most), motion, look and loss; the legend says what they are."""
    settings = network.settings
    light = scene.light(network.pattern, scale=network.scale, alpha=settings["alpha"])
    spikes = simulate_spikes(light, generator=torch.Generator().manual_seed(0))[None]
    truth = scene.rgb(scene.middle)[None]

    def seeing() -> tuple[Tensor, Tensor]:
        return expected_errors(scene_activity(spikes, network.pattern, settings["alpha"]), network.error_model)

    runs = {value: partial(forward_in_tiles, network, spikes, tile, value) for value in (0.0, *tolerances)}
    timer, _ = timer_of(spikes.device, torch.get_num_threads())
    times = interleave({**runs, -1.0: seeing}, rounds, timer)
    best = psnr(runs[0.0]().clamp(0, 1), truth).item()
    for value in tolerances:
        moving = moving_cells(*seeing(), value).float().mean().item()
        lost = best - psnr(runs[value]().clamp(0, 1), truth).item()
        yield value, *ratio(times[value], times[0.0]), moving, ratio(times[-1.0], times[value]).median, lost


def fit(sources: Sequence[str], pictures: Sequence[Path], held_out: Sequence[Path], count: int) -> Iterator[str]:
    """Fit the error models of weights, write them beside the weights, and yield the lines of a table.

    Args:
        sources: names or files of safetensors. Those whose networks take the same clips share them.
        pictures: what the clips show that are fitted.
        held_out: what the others show.
        count: how many clips there are of either.

    Raises:
        FileNotFoundError: neither a file nor the name of one.
        ValueError: weights that are in no file of safetensors, or whose networks are not run in tiles.
    """
    groups: dict[tuple, list[tuple[str, Path, Network]]] = {}
    for source in sources:
        path, network = read_weights(source).source, CSCSR.from_pretrained(source)
        if path.suffix != ".safetensors":
            raise ValueError(f"{source}: expected a file of safetensors, such as lightning export writes")
        alike = network.scale, network.pattern, network.settings["alpha"], network.frames
        groups.setdefault(alike, []).append((source, path, network))
    yield "| weights | tolerance | worst loss | mean loss | motion |"
    yield "|---|---|---|---|---|"
    for alike, members in groups.items():
        fitted, others = (_errors(members, make_clips(shown, count, *alike)) for shown in (pictures, held_out))
        for source, path, _ in members:
            model = fit_error_model(fitted[source])
            write_error_model(path, model)
            for tolerance in tolerance_fit.TOLERANCES:
                losses, moving = zip(*(loss(clip, model, tolerance) for clip in others[source]), strict=True)
                shares = f"{mean(losses):.3f} | {mean(moving):.0%}"
                yield f"| {source} | {tolerance:g} | {max(losses):.3f} | {shares} |"


def _errors(members: Sequence[tuple[str, Path, Network]], clips: Iterable[Clip]) -> dict[str, list[Errors]]:
    found: dict[str, list[Errors]] = {source: [] for source, _, _ in members}
    for clip in clips:
        flows: dict[tuple[int, int, int], Tensor] = {}
        for source, _, network in members:
            if network.flow_times not in flows:
                flows[network.flow_times] = network.estimate_flow(clip.spikes)
            found[source].append(measure_errors(network, clip, flows[network.flow_times]))
    return found


#: what tiles may change in a picture: a hundredth of a step of 8 bits
BOUND = 0.01 / 255

HALO_TILE = 64


@torch.no_grad()
def measure_halo(network: Network, start: int = 8) -> int:
    """Return the smallest halo with which tiles give what the whole picture gives, in float64, on a clip of noise.

    Args:
        network: a network that is run in tiles; it is left as it is.
        start: the smallest halo that is tried, even.

    Returns:
        The halo in sensor pixels, even.
    """
    network, spikes = copy.deepcopy(network).double(), _noise(network)
    whole = network(spikes, static=True)
    for halo in range(start, HALO_TILE, 2):
        network.halo = halo
        if (forward_in_tiles(network, spikes, HALO_TILE, static=True) - whole).abs().max() < BOUND:
            return halo
    return HALO_TILE


def _noise(network: Network) -> Tensor:
    texture = torch.rand(3, HALO_TILE, 2 * HALO_TILE, generator=torch.Generator().manual_seed(0))
    view = texture.repeat_interleave(2, 1).repeat_interleave(2, 2)
    light = Scene([Layer(view)], *view.shape[1:], network.frames).light(
        network.pattern, scale=2, alpha=network.settings["alpha"]
    )
    return simulate_spikes(light, generator=torch.Generator().manual_seed(0))[None]


def _tile(text: str) -> int:
    side = whole(0)(text)
    if side % 2:
        raise argparse.ArgumentTypeError(f"expected an even number of sensor pixels, or 0 for no tiles, got {text}")
    return side


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("weights", nargs="+", help="those of CSCSR: names, files of safetensors or, without --fit, checkpoints")
    add("--pictures", help="folder of pictures; without it, those of scikit-image, held-out ones for the table")
    add("--fit", action="store_true", help="fit the constants of the weights, and write them beside them")
    add("--halo", action="store_true", help="print the halo that tiles need, to a hundredth of an 8-bit step")
    add("--clips", type=whole(1), default=8, help="with --fit: clips that are fitted, and as many others")
    add("--height", type=int, default=250, help="sensor rows")
    add("--width", type=int, default=400, help="sensor columns")
    add("--tile", type=_tile, default=128, help="as of lightning predict")
    add("--rounds", type=int, default=3, help="timings of each")
    add("--tolerances", type=float, nargs="+", default=TOLERANCES, metavar="DB")
    args = parser.parse_args(arguments)
    given = None if args.pictures is None else folder_pictures(args.pictures)
    if args.fit:
        shown, others = (
            (embedded_pictures(), embedded_pictures(held_out=True)) if given is None else split_pictures(given, 0)
        )
        for line in fit(args.weights, shown, others, args.clips):
            print(line, flush=True)
        return
    if args.halo:
        for weights in args.weights:
            print(f"{weights}: {measure_halo(CSCSR.from_pretrained(weights))}", flush=True)
        return
    pictures = embedded_pictures(held_out=True) if given is None else given
    ground, thing = (read_picture(pictures[i % len(pictures)]) for i in (0, 1))
    _, timer = timer_of(torch.device("cpu"), torch.get_num_threads())
    print(_LEGEND.format(rounds=args.rounds, timer=timer))
    for weights in args.weights:
        print(f"| {weights} | tolerance | time | motion | look | loss |\n|---|---|---|---|---|---|")
        network = CSCSR.from_pretrained(weights)
        for name, scene in scenes(ground, thing, args.height, args.width, network.scale):
            for value, median, least, most, moving, seen, lost in rows(
                network, scene, args.tolerances, args.tile, args.rounds
            ):
                shares = f"{median:.2f} ({least:.2f} to {most:.2f}) | {moving:.0%} | {seen:.1%}"
                print(f"| {name} | {value:g} | {shares} | {lost:.3f} |", flush=True)


if __name__ == "__main__":
    main()

"""Measure time and quality of films of partly still scenes: ``python benchmarks/film_activity.py``.

The scenes have known truth. The film is compared with one that recomputes everything, timed in turn. ``--overlay
FOLDER`` writes pictures of both side by side, with recomputed parts in green. ``--false-rests`` measures
instead how often cells count as resting while the scene moves by half a sensor pixel from picture to picture. ``exact
light`` is the limit of a still scene: the network's picture of exact light instead of spikes.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from operator import truediv
from pathlib import Path
from statistics import mean

import torch
import torch.nn.functional as F
from scipy.stats import chi2
from torch import Tensor

from lightning_modules.data.pictures import embedded_pictures
from lightning_modules.inference.clips import film_groups
from lightning_modules.inference.film import FilmMaker
from lightning_modules.inference.rest import CELL, Rest
from lightning_modules.networks import Network
from spikekit import (
    Calibration,
    SensorNoise,
    bin_to_sensor,
    demosaic,
    psnr,
    read_picture,
    simulate_spikes,
    write_picture,
)
from spikekit.arguments import whole
from spikekit.scenes.analytic import Layer, Motion, Scene

EVERY = 20
ALPHA = 0.4
NOISE = SensorNoise(photons=30_000, dark_current=0.0047, dark_spread=0.39, gain_spread=0.06)


def scenes(size: tuple[int, int], clocks: int, scale: int) -> Iterator[tuple[str, Scene, Callable[[int], float]]]:
    """Yield names, scenes of ``size`` sensor pixels, and their brightness as a function of the clock."""
    ground, thing = (read_picture(path) for path in embedded_pictures()[:2])
    view = [scale * side for side in size]
    side = scale * round(math.sqrt(0.05 * size[0] * size[1] * 4 / math.pi))
    y, x = (torch.linspace(-1, 1, side) for _ in range(2))
    thing = thing[:, :side, :side]
    disc = (y[:, None].square() + x.square() <= 1).to(thing)
    speed = min(0.1 * scale, 0.5 * view[1] / clocks)
    moving = Layer(thing, Motion(velocity=(speed, 0.0)), (view[1] // 2 - side // 2, view[0] // 2 - side // 2), disc)
    still = Scene([Layer(ground)], *view, clocks)
    yield "still", still, lambda _: 1.0
    yield "object of 5 %", Scene([Layer(ground), moving], *view, clocks), lambda _: 1.0
    yield "flicker of 100 Hz", still, lambda clock: 1 + 0.25 * math.sin(2 * math.pi * clock / 200)
    yield "noisy sensor", still, lambda _: 1.0
    yield "calibrated sensor", still, lambda _: 1.0
    yield "dark", still, lambda _: 0.05
    for name, speed in (("panning", 0.1), ("slow panning", 0.02)):
        yield name, Scene([Layer(ground, Motion(velocity=(speed * scale, 0.0)))], *view, clocks), lambda _: 1.0


def film_of(scene: Scene, bright: Callable[[int], float], network: Network, noise: SensorNoise | None = None) -> Tensor:
    """Simulate the spikes of a scene, (clocks, H, W)."""
    scale, pattern = network.scale, network.pattern
    if all(layer.motion == Motion() for layer in scene.layers):
        light = ALPHA * bin_to_sensor(scene.rgb(0), pattern, scale=scale).expand(scene.frames, -1, -1)
    else:
        light = scene.light(pattern, scale=scale, alpha=ALPHA)
    light = light * torch.tensor([bright(clock) for clock in range(scene.frames)])[:, None, None]
    return simulate_spikes(light, generator=torch.Generator().manual_seed(0), noise=noise).byte()


def known_sensor(size: tuple[int, int]) -> Calibration:
    """Return a sensor with the spreads of ``NOISE`` and two dead pixels in a thousand."""
    generator = torch.Generator().manual_seed(0)
    gain, dark = (torch.randn(size, generator=generator) for _ in range(2))
    dead = torch.rand(size, generator=generator) < 0.002
    return Calibration((NOISE.gain_spread * gain).exp(), NOISE.dark_current * (0.39 * dark).exp(), dead.byte())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", default="cscsr_tiny_x4")
    parser.add_argument("--size", type=whole(16), nargs=2, default=[96, 128])
    parser.add_argument("--pictures", type=whole(12), default=60)
    parser.add_argument("--scene", action="append", help="only scenes whose names start with this")
    parser.add_argument("--overlay", type=Path)
    parser.add_argument("--false-rests", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.false_rests:
        false_rests(tuple(args.size), args.pictures)
        return
    network = Network.from_pretrained(args.weights)
    clocks = EVERY * (args.pictures - 1) + network.frames
    figures = "time after 10,cells after 10,plain PSNR,PSNR after 1,after 10,at the end,of what moves"
    print(f"weights,sensor pixels,scene,{figures}")
    for name, scene, bright in scenes(tuple(args.size), clocks, network.scale):
        if args.scene and not name.startswith(tuple(args.scene)):
            continue
        network.noise_level = float(name == "noisy sensor")
        known = known_sensor(tuple(args.size)) if name == "calibrated sensor" else None
        noise = SensorNoise(NOISE.photons, calibration=known) if known else NOISE if name == "noisy sensor" else None
        spikes = film_of(scene, bright, network, noise)
        plain, resting = FilmMaker(network), FilmMaker(network, psnr_tolerance=0.1)
        plain.calibration = resting.calibration = known
        times, cells, found, moving = [], [], [], []
        shown = range(network.frames // 2, clocks - network.frames // 2, EVERY)
        clips = {clock: spikes[None, clock - network.frames // 2 :][:, : network.frames] for clock in shown}
        for clock, made, took, computed in in_turns(clips, (plain, resting), network.settings["alpha"] / ALPHA):
            truth = (bright(clock) * scene.rgb(clock)).clamp(0, 1)
            times.append(took)
            cells.append(computed.float().mean().item())
            found.append([psnr(picture, truth).item() for picture in made])
            if len(found) > 11 and any(layer.motion != Motion() for layer in scene.layers):
                part = (scene.rgb(clock - EVERY) != scene.rgb(clock + EVERY)).any(0)
                moving.append(-10 * math.log10(apart(made[1], truth, part) / apart(made[0], truth, part)))
            if args.overlay:
                write_overlay(args.overlay, f"{name.split()[0]}_{clock:05}.png", made, truth, computed)
        late = zip(*times[11:], strict=True)
        ratio, share = 1 / truediv(*map(sum, late)), mean(cells[11:])
        figures = [mean(one for one, _ in found), *(found[n][1] - found[n][0] for n in (1, 10, -1))]
        written = [f"{figure:.2f}" for figure in figures] + [f"{mean(moving):.2f}" if moving else ""]
        size = " x ".join(map(str, args.size))
        print(f"{args.weights},{size},{name},{ratio:.3f},{share:.3f},{','.join(written)}", flush=True)
        if name == "still":
            gain = psnr(of_exact_light(network, scene.rgb(0)), scene.rgb(0)).item() - figures[0]
            print(f"{args.weights},{size},exact light,,,{figures[0]:.2f},,,{gain:.2f},", flush=True)


def in_turns(
    clips: dict[int, Tensor], makers: tuple[FilmMaker, FilmMaker], exposure: float
) -> Iterator[tuple[int, list[Tensor], list[float], Tensor]]:
    """Yield the clock, the pictures of both films, their seconds, and the cells that the second one computed."""
    for group in film_groups(clips, 1, makers[1].together(EVERY)):
        made = []
        for clock in group:
            start = time.process_time()
            picture = makers[0](clips[clock], [clock], exposure=exposure)[0]
            made.append((picture, time.process_time() - start))
        start = time.process_time()
        pictures = makers[1](torch.cat([clips[clock] for clock in group]), group, exposure=exposure)
        seconds = (time.process_time() - start) / len(group)
        for n, clock in enumerate(group):
            yield clock, [made[n][0], pictures[n]], [made[n][1], seconds], makers[1].computed[n]


def of_exact_light(network: Network, truth: Tensor) -> Tensor:
    """Return the network's picture of the exact light of every sensor pixel, corrected towards it like a film's."""
    light = bin_to_sensor(truth, network.pattern, scale=network.scale)
    clip = (network.settings["alpha"] * light).expand(1, network.frames, -1, -1)
    with torch.no_grad():
        picture = network(clip, static=True)[0].clamp(0, 1)
    off = demosaic(light - bin_to_sensor(picture, network.pattern, scale=network.scale), network.pattern)
    enlarged = F.interpolate(off[None], scale_factor=network.scale, mode="bilinear", antialias=True)[0]
    return (picture + enlarged).clamp(0, 1)


def apart(picture: Tensor, truth: Tensor, part: Tensor) -> float:
    """Mean squared error of a part (H, W) of a picture."""
    return (picture - truth)[:, part].square().mean().item()


def false_rests(size: tuple[int, int], pictures: int) -> None:
    """Print how many cells that move are said to rest, by how much their light changes; a quarter does rest."""
    print("sensor,change of light (rms / white),cells and pictures,false rests in 10 000,at most (95 %)")
    for sensor, noise in (("ideal", None), ("noisy", NOISE)):
        films = [_rests_of_film(read_picture(path), size, pictures, noise) for path in embedded_pictures()]
        change, false = (torch.cat(cells) for cells in zip(*films, strict=True))
        for least in (0.0, 0.0025, 0.005, 0.01, 0.02):
            seen = change >= least
            count, wrong = seen.sum().item(), false[seen].sum().item()
            most = chi2.ppf(0.95, 2 * wrong + 2) / 2
            print(f"{sensor},>= {least:g},{count},{1e4 * wrong / count:.2f},{1e4 * most / count:.2f}", flush=True)


def _rests_of_film(
    picture: Tensor, size: tuple[int, int], pictures: int, noise: SensorNoise | None
) -> tuple[Tensor, Tensor]:
    """Return by how much the light of cells that move changes, and which of them are said to rest."""
    clocks, scale, moving = EVERY * pictures + 21, 2, size[0] * 3 // 4 // CELL * CELL
    layer = Layer(picture, Motion(velocity=(0.5 * scale / EVERY, 0.0)))
    light = Scene([layer], scale * size[0], scale * size[1], clocks).light("RGGB", scale=scale, alpha=ALPHA)
    light[:, moving:] = light[0, moving:].clone()
    spikes = simulate_spikes(light, generator=torch.Generator().manual_seed(0), noise=noise)
    rest, nothing, changes, resting = Rest(1, "RGGB", ALPHA, float(noise is not None)), torch.zeros(3, *size), [], []
    for clock in range(20, clocks - 20, EVERY):
        rest(spikes[clock - 20 : clock + 21], clock, lambda box, static: box.of(nothing), 1.0, None)
        change = (light[clock] - light[clock - EVERY]) / ALPHA
        changes.append(F.avg_pool2d(change.square()[None], CELL, ceil_mode=True)[0].sqrt())
        resting.append(~rest.moving)
    change, false = (torch.stack(cells[7:])[:, : moving // CELL].flatten() for cells in (changes, resting))
    return change, false


def write_overlay(folder: Path, name: str, made: list[Tensor], truth: Tensor, computed: Tensor) -> None:
    """Write the plain picture, the other, what was computed of it, and four times their difference."""
    folder.mkdir(parents=True, exist_ok=True)
    side = CELL * truth.shape[-1] // (CELL * computed.shape[-1])
    green = computed.repeat_interleave(side, 0).repeat_interleave(side, 1)[: truth.shape[-2], : truth.shape[-1]]
    made = [picture.expand(3, -1, -1) for picture in made]  # grey ones too
    shown = made[1].clone()
    shown[1] = torch.where(green, 0.6 * shown[1] + 0.4, shown[1])
    apart = (0.5 + 4 * (made[1] - made[0])).clamp(0, 1)
    rows = torch.cat([torch.cat([made[0], made[1]], -1), torch.cat([shown, apart], -1)], -2)
    write_picture(folder / name, rows)


if __name__ == "__main__":
    main()

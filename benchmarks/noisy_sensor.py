"""Measure the benefit of a calibration on a noisy sensor, for decoders and a network.

``python benchmarks/noisy_sensor.py PICTURES`` prints the table. Moving still pictures are recorded by a BGGR sensor
with another gain than that of the training data. Without a calibration, networks get clips whose defects are filled, as
from ``lightning predict``; those with a noise level are told the measured one.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from lightning_modules.data.pictures import folder_pictures
from lightning_modules.data.stills import StillClips
from lightning_modules.networks import CSCSR
from spikekit import SensorNoise, SpikeSensor, correct_spikes, demosaic, fill_defects, psnr, tfi_at, tfp_at
from spikekit.calibration.calibration import Calibration
from spikekit.calibration.gain_spread import gain_spread
from spikekit.calibration.in_motion import calibrate_in_motion, count_segments, segment_length
from spikekit.calibration.measure import calibrate, find_defects
from spikekit.calibration.pixel_rates import PixelRates
from spikekit.tables import table

ALPHA, PATTERN, FRAMES, PATCH = 0.25, "BGGR", 401, 80
NOISE = SensorNoise(photons=3000, dark_current=0.0047, dark_spread=0.39, gain_spread=0.06, hot=0.001, dead=0.002)

_MIDDLES = 100, 200, 300


def measure(picture: Path, network: CSCSR, seed: int) -> dict[str, list[float]]:
    """Return, by calibration, PSNR by TFI, by TFP 13 of order 3 and by the network, over three moments of a scene."""
    clips = StillClips(
        [picture],
        scale=network.scale,
        patch=PATCH,
        frames=FRAMES,
        pattern=PATTERN,
        alpha=ALPHA,
        motion=16.0,
        brightness=(1.0, 1.0),
        flow_times=(0,),
        seed=seed,
        augment=False,
    )
    scene = clips.scene(0)
    light = scene.light(PATTERN, scale=network.scale, alpha=ALPHA)
    sensor = SpikeSensor(NOISE, seed=seed)
    spikes = sensor.expose(light)
    ideal = SpikeSensor(SensorNoise(photons=NOISE.photons), seed=seed).expose(light)
    flat = sensor.expose(torch.full((1000, *light.shape[1:]), 0.6 * ALPHA))
    dark = sensor.expose(torch.zeros(2000, *light.shape[1:]))
    rates = PixelRates.of([spikes])
    defects = find_defects(rates, PATTERN).calibration
    segments = count_segments([spikes], segment_length(rates.rate.mean().item()))
    moved = calibrate_in_motion(segments, defects, PATTERN)
    calibrations = {
        "none": None,
        "from the scene: dead and hot pixels": defects,
        "from the scene in motion": moved.calibration if moved else defects,
        "from a flat and a dark recording": calibrate(_halves(flat), _halves(dark), PATTERN).calibration,
    }
    truth = {middle: scene.rgb(middle).float() for middle in _MIDDLES}
    scores = {name: _scores(spikes, truth, network, known) for name, known in calibrations.items()}
    return scores | {"none, an ideal sensor": _scores(ideal, truth, network, None)}


def _halves(spikes: Tensor) -> tuple[PixelRates, PixelRates]:
    middle = len(spikes) // 2
    return PixelRates.of([spikes[:middle]]), PixelRates.of([spikes[middle:]])


def _scores(spikes: Tensor, truth: dict[int, Tensor], network: CSCSR, known: Calibration | None) -> list[float]:
    decoders: list[Callable[[Tensor, int], Tensor]] = [tfi_at, lambda clip, middle: tfp_at(clip, middle, 13, order=3)]
    sums = [0.0] * 3
    corrected = fill_defects(spikes, PATTERN) if known is None else correct_spikes(spikes, known, PATTERN)
    rates = corrected[:400].unflatten(0, (2, -1)).float().mean(1)
    spread = gain_spread(rates, 200, PATTERN)
    network.noise_level = 1.0 if spread is None else spread / NOISE.gain_spread
    for middle, rgb in truth.items():
        near = spikes[middle - 60 : middle + 61].float()
        small = F.avg_pool2d(rgb, network.scale)
        for n, decode in enumerate(decoders):
            raw = decode(near, 60) if known is None else known.correct(decode(near, 60), PATTERN)
            sums[n] += psnr(demosaic(raw[None] / ALPHA, PATTERN)[0].clamp(0, 1), small).item()
        clip = corrected[middle - network.frames // 2 :][: network.frames]
        # from (1, 1) on, BGGR is RGGB
        with torch.no_grad():
            seen = network(clip[None, :, 1:, 1:])[0].clamp(0, 1)
        sums[2] += psnr(seen, rgb[:, network.scale :, network.scale :]).item()
    return [total / len(truth) for total in sums]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("pictures", help="folder of pictures")
    parser.add_argument("--weights", default="cscsr_small_x4", help="weights of CSCSR; default: %(default)s")
    parser.add_argument("--count", type=int, default=4, help="number of pictures, spread over the folder; default: 4")
    args = parser.parse_args()
    network = CSCSR.from_pretrained(args.weights, alpha=ALPHA)
    found = folder_pictures(args.pictures)
    chosen = [found[n * len(found) // args.count] for n in range(args.count)]
    rows = defaultdict(list)
    for seed, picture in enumerate(chosen):
        for name, scores in measure(picture, network, seed).items():
            rows[name].append(torch.tensor(scores))
    names = ", ".join(picture.name for picture in chosen)
    lines = [[name, *(f"{value:.2f}" for value in torch.stack(row).mean(0).tolist())] for name, row in rows.items()]
    print(table([names, "TFI", "TFP 13, order 3", args.weights], lines))


if __name__ == "__main__":
    main()

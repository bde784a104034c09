"""Measure pictures of dim recordings, with and without joined frames, or longer clips of a decoder.

``python benchmarks/light.py PICTURES`` prints PSNR in dB and writes ``results/light.csv``: eight pictures of the folder
move by up to 0.6 and by up to 3 sensor pixels in 20 spike frames; the recordings have 205. A clip without joined frames
has the length that the network was trained with; ``reconstruct`` joins frames, or gives a decoder more of them.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from lightning_modules import reconstruct
from lightning_modules.data.pictures import folder_pictures
from lightning_modules.data.stills import StillClips
from lightning_modules.inference.predict import predict
from lightning_modules.networks import ClassicalDecoder, Network
from spikekit import psnr, write_spikes
from spikekit.tables import table

WEIGHTS = "cscsr_small_grey_x1", "cscsr_huge_x2", "cscsr_huge_x4", "cscsr_huge_long_x4"
ALPHAS, MOTIONS, FRAMES, CLIPS = (0.03, 0.05, 0.1, 0.2, 0.4), (3.0, 15.0), 205, 8


@torch.inference_mode()
def measure(network: Network, pictures: list[Path], alpha: float, motion: float, patch: int) -> tuple[float, float]:
    """Return mean PSNR of pictures without and with joined frames, or longer clips."""
    clips = StillClips(
        pictures,
        scale=network.scale,
        patch=patch,
        frames=FRAMES,
        pattern=network.pattern,
        alpha=alpha,
        motion=motion,
        bend=motion / 5,
        rotation=motion / 3,
        zoom=motion / 300,
        flow_times=(0, FRAMES - 1),
        augment=False,
    )
    middle, half = FRAMES // 2, network.frames // 2
    scores = []
    for n in range(CLIPS):
        clip = clips[n]
        alone = clip["spikes"][None, middle - half : middle + half + 1]
        rgb = predict(network, alone, exposure=network.settings["alpha"] / alpha)[0]
        with TemporaryDirectory() as folder:
            path = Path(folder) / "clip.npz"
            write_spikes(path, clip["spikes"])
            known = {"pattern": network.pattern, "white": alpha, "calibration": "none", "precision": "32-true"}
            ((_, joined),) = reconstruct(path, network=network, frame=str(middle), **known)
        truth = clip["rgb"][None]
        scores.append([psnr(one[None, : truth.shape[1]], truth).item() for one in (rgb, joined)])
    plain, better = torch.tensor(scores).mean(0).tolist()
    return plain, better


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("pictures", type=Path, help="folder of pictures")
    parser.add_argument("--patch", type=int, default=40, help="side of a clip in sensor pixels; default: 40")
    parser.add_argument("-o", "--output", type=Path, default=Path("results/light.csv"), help="default: %(default)s")
    args = parser.parse_args()
    pictures = folder_pictures(args.pictures)
    networks = {"TFP 13, order 3, grey": ClassicalDecoder("tfp", 1, "grey", window=13, order=3)}
    networks |= {name: Network.from_pretrained(name).eval() for name in WEIGHTS}
    head = ["alpha", "pixels in 20 frames"]
    for name, network in networks.items():
        head += [f"{name}, alone", f"{name}, {'joined' if network.joins else 'longer'}"]
    rows = []
    for alpha in ALPHAS:
        for motion in MOTIONS:
            found = [measure(network, pictures, alpha, motion, args.patch) for network in networks.values()]
            rows.append([f"{alpha:g}", f"{motion / 5:g}", *(f"{value:.2f}" for pair in found for value in pair)])
            print(rows[-1], flush=True)
    print(table(head, rows))
    with args.output.open("w", newline="") as file:
        csv.writer(file).writerows([head, *rows])


if __name__ == "__main__":
    main()

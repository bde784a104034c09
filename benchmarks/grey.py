"""Evaluate reconstructions of grey recordings with known truth, such as the REDS clips of the literature.

``python benchmarks/grey.py FOLDER [WEIGHTS ...]`` prints PSNR and SSIM up to exposure and the CPU seconds per picture
of TFI, TFP, TFP of third order and networks, and writes them to ``results/grey.csv``. Weights are names or files. Those
for Bayer sensors treat the grey stream as a mosaic; pictures larger than the sensor are averaged down. FOLDER is
searched recursively for recordings with a truth beside them:

- ``spike/NAME_key_idK.dat`` and ``gt/NAME_key_idK.png``, the K-th frame: Spike-Zoo's BASE set as its repository has it;
- ``NAME.dat``, or with a size as ``NAME_250x400.dat``, and ``NAME_truth_N.png``, frame N counted from 0.

Up to exposure: the picture is scaled by the factor that fits the truth best in least squares.
"""

from __future__ import annotations

import argparse
import csv
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from lightning_modules.inference.predict import predict
from lightning_modules.networks import Network, RecurrentCSCSR
from spikekit import bin_to_sensor, psnr, read_picture, read_spikes, ssim, tfi_at, tfp_at
from spikekit.color.cfa import GREY
from spikekit.tables import table

#: reconstructs a frame of a recording: (T, H, W) and its index to (H, W)
Method = Callable[[Tensor, int], Tensor]


@dataclass
class Known:
    """A recording with a known truth at one of its frames."""

    name: str
    path: Path
    frame: int
    truth: Path

    def read(self, height: int, width: int, flip: bool) -> tuple[Tensor, Tensor]:
        """Return spikes (T, H, W) and the truth (H, W)."""
        named = re.search(r"_(\d+)x(\d+)$", self.path.stem)
        height, width = map(int, named.groups()) if named else (height, width)
        spikes = read_spikes(self.path, height=height, width=width, flip=flip)
        truth = read_picture(self.truth)
        truth = truth if truth.ndim == 2 else bin_to_sensor(truth, GREY, scale=1)
        if truth.shape != spikes.shape[1:] or not 0 <= self.frame < len(spikes):
            got = f"{tuple(truth.shape)} and frame {self.frame}"
            raise SystemExit(f"{self.truth}: expected a frame of {tuple(spikes.shape)} spikes, got {got}")
        return spikes, truth


def recordings(folder: Path) -> Iterator[Known]:
    """Find the recordings with a truth in a folder, sorted by name."""
    for path in sorted(folder.rglob("*.dat")):
        keyed = re.search(r"_key_id(\d+)$", path.stem)
        picture = path.parent.parent / "gt" / f"{path.stem}.png"
        if keyed and picture.exists():
            yield Known(path.stem[: keyed.start()], path, int(keyed[1]) - 1, picture)
        name = re.sub(r"_\d+x\d+$", "", path.stem)
        for truth in sorted(path.parent.glob(f"{name}_truth_*.png")):
            yield Known(name, path, int(truth.stem.rpartition("_")[2]), truth)


def judge(picture: Tensor, truth: Tensor) -> tuple[float, float]:
    """Return PSNR in dB and SSIM of (H, W), up to exposure."""
    picture, truth = picture.double(), truth.double()
    gain = (picture * truth).sum() / picture.square().sum().clamp(min=torch.finfo(torch.float64).tiny)
    pair = (gain * picture)[None], truth[None]
    return psnr(*pair).item(), ssim(*pair).item()


@torch.inference_mode()
def by_network(network: Network, every: int, spikes: Tensor, frame: int) -> Tensor:
    """Reconstruct a frame; a network for films sees the key frames on both sides as well."""
    half = network.frames // 2
    film = isinstance(network, RecurrentCSCSR)
    frames = [frame - every, frame, frame + every] if film else [frame]
    if frames[0] < half or frames[-1] + half >= len(spikes):
        raise SystemExit(f"expected {frames[-1] + half + 1} frames of spikes or more, got {len(spikes)}")
    clips = torch.stack([spikes[n - half : n + half + 1] for n in frames])
    if film:
        picture = network(clips[None], every=every, future=len(frames) - 1)[0, 1]
    else:
        # as light, at most 1 for any white level, since predict clips brighter pixels
        picture = predict(network, clips, exposure=network.settings["alpha"])[0]
    picture = F.avg_pool2d(picture.clamp(min=0), network.scale)
    return bin_to_sensor(picture, GREY, scale=1)


def methods(weights: list[str], every: int) -> dict[str, Method]:
    """Return the decoders and the networks, by name."""
    found: dict[str, Method] = {"TFI": tfi_at, "TFP 41": partial(tfp_at, window=41)}
    found |= {f"TFP {window}, order 3": partial(tfp_at, window=window, order=3) for window in (9, 13)}
    for name in weights:
        network = Network.from_pretrained(name).eval()
        read = "" if network.pattern == GREY else f", as {network.pattern}"
        shown = name if "/" not in name else Path(name).stem
        found[f"{shown}{read}{', averaged down' if network.scale > 1 else ''}"] = partial(by_network, network, every)
    return found


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="recordings and truths")
    parser.add_argument("weights", nargs="*", help="names or files of weights")
    parser.add_argument("--height", type=int, default=250, help="rows, if the name has no size; default: 250")
    parser.add_argument("--width", type=int, default=400, help="columns; default: 400")
    parser.add_argument("--upright", action="store_true", help="frames are not stored upside down")
    parser.add_argument("--every", type=int, default=20, help="clocks between key frames of a film; default: 20")
    parser.add_argument("-o", "--output", type=Path, default=Path("results/grey.csv"), help="default: %(default)s")
    args = parser.parse_args()
    known = list(recordings(args.folder))
    if not known:
        raise SystemExit(f"{args.folder}: expected recordings with a truth, see the head of this file, got none")
    rows: list[list[str]] = []
    for name, method in methods(args.weights, args.every).items():
        scores = []
        for one in known:
            spikes, truth = one.read(args.height, args.width, not args.upright)
            if not scores:
                method(spikes, one.frame)  # warm up, to exclude compilation
            begin = time.process_time()
            picture = method(spikes, one.frame)
            scores.append([*judge(picture, truth), time.process_time() - begin])
            rows.append([name, one.name, *_written(scores[-1])])
        rows.append([name, "mean", *_written(torch.tensor(scores, dtype=torch.float64).mean(0).tolist())])
    head = ["method", "recording", "PSNR (dB)", "SSIM", "CPU seconds"]
    print(table(head, rows))
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with args.output.open("w", newline="") as file:
        csv.writer(file).writerows([head, *rows])


def _written(scores: list[float]) -> list[str]:
    return [f"{value:.{digits}f}" for value, digits in zip(scores, (2, 4, 3), strict=True)]


if __name__ == "__main__":
    main()

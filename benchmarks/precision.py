"""Cost and benefit of bfloat16: PSNR and time of networks in both precisions, in turn, in one process.

python benchmarks/precision.py PICTURES [--weights NAME ...]

Writes results/precision.csv. The scenes are moving PICTURES, in clips of 96 x 96 sensor pixels.
"""

import argparse
import csv
import time
from pathlib import Path

import torch

from lightning_modules.data.pictures import folder_pictures
from lightning_modules.data.stills import StillClips
from lightning_modules.metrics.image import psnr
from lightning_modules.networks import CSCSR

RESULTS = Path(__file__).parents[1] / "results" / "precision.csv"


def seconds(device: str) -> float:
    """Return process time on a CPU, and wall time elsewhere."""
    if device == "cuda":
        torch.cuda.synchronize()
    return time.process_time() if device == "cpu" else time.perf_counter()


@torch.inference_mode()
def measure(name: str, pictures: list[Path], device: str) -> dict[str, object]:
    """Return a row of the table."""
    network = CSCSR.from_pretrained(name).to(device)
    config = network.config
    clips = StillClips(
        pictures, scale=network.scale, patch=96, frames=config.frames, pattern=config.pattern, motion=4.0, bend=0.5,
        augment=False, length=len(pictures), flow_times=(network.times[0], network.times[-1]),
    )  # fmt: skip
    took, scores = {False: 0.0, True: 0.0}, {False: [], True: []}
    for n in range(len(clips)):
        spikes, rgb = clips[n]["spikes"][None].to(device).float(), clips[n]["rgb"].to(device)
        flow = network.estimate_flow(spikes)
        for half in (False, True) if n % 2 else (True, False):
            with torch.autocast(device, torch.bfloat16, enabled=half):
                if n < 2:
                    network(spikes, flow)
                begin = seconds(device)
                picture = network(spikes, flow)
                took[half] += seconds(device) - begin
            scores[half].append(psnr(picture[0].float().clamp(0, 1), rgb).item())
    losses = [wide - half for wide, half in zip(scores[False], scores[True], strict=True)]
    return {
        "weights": name,
        "clips": len(clips),
        "times as fast": f"{took[False] / took[True]:.2f}",
        "PSNR (dB)": f"{sum(scores[False]) / len(clips):.3f}",
        "mean loss": f"{sum(losses) / len(clips):.4f}",
        "largest loss": f"{max(losses):.4f}",
    }


def main() -> None:
    """Measure, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pictures", type=Path)
    parser.add_argument("--weights", nargs="+", default=["cscsr_tiny_x4", "cscsr_small_x4", "cscsr_huge_x4"])
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for name in args.weights:
        rows.append(measure(name, folder_pictures(args.pictures), args.device))
        print(*(f"{key} {value}" for key, value in rows[-1].items()), sep="  ", flush=True)
    RESULTS.parent.mkdir(exist_ok=True)
    with RESULTS.open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0])
        table.writeheader()
        table.writerows(rows)


if __name__ == "__main__":
    main()

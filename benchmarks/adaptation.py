"""Measure the benefit of ``lightning adapt`` on scenes of known truth.

``python benchmarks/adaptation.py PICTURES`` prints the table. Moving still pictures are recorded by one noisy sensor.
Weights are adapted to each recording, and tested on its end and on the end of the next one.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from noisy_sensor import NOISE
from torch import Tensor

from lightning_modules.adaptation.distillation import HELD_OUT, chosen_frames, make_distillation_set
from lightning_modules.adaptation.fine_tune import fine_tune
from lightning_modules.cli.command import without_chatter
from lightning_modules.data.pictures import folder_pictures
from lightning_modules.data.stills import StillClips
from lightning_modules.inference.clips import RecordingClips
from lightning_modules.inference.predict import predict
from lightning_modules.networks import Network
from spikekit import SensorNoise, SpikeSensor, psnr, write_spikes
from spikekit.recording import open_recording
from spikekit.tables import table

FRAMES, PATCH = 601, 80
#: displacement of the scenes in half of these frames, in sensor pixels; they take turns
MOTION = 24.0, 12.0, 6.0


@dataclass
class Seen:
    """A recording of known truth."""

    path: Path
    alpha: float
    frames: list[int]
    truth: list[Tensor]

    def clips(self, frames: int) -> RecordingClips:
        """Return its clips of ``frames`` frames, of an unknown sensor."""
        return RecordingClips(replace(open_recording(self.path), pattern="RGGB"), frames)

    def psnr(self, network: Network) -> float:
        """Return the PSNR in dB of the held-out pictures by a network."""
        exposure = network.settings["alpha"] / self.alpha
        clips = self.clips(network.frames).in_order(self.frames)
        seen = [predict(network, clip[None], exposure=exposure)[0] for _, clip in clips]
        return torch.stack([psnr(*pair) for pair in zip(seen, self.truth, strict=True)]).mean().item()


def record(picture: Path, number: int, noise: SensorNoise, alpha: float, scale: int, frames: int, path: Path) -> Seen:
    """Simulate a moving still picture, always with the same sensor; ``frames`` is the length of the longest clip."""
    stills = StillClips(
        [picture],
        scale=scale,
        patch=PATCH,
        frames=FRAMES,
        alpha=alpha,
        motion=MOTION[number % len(MOTION)],
        brightness=(1.0, 1.0),
        flow_times=(0,),
        seed=number,
        augment=False,
    )
    scene = stills.scene(0)
    write_spikes(path, SpikeSensor(noise, seed=0).expose(scene.light("RGGB", scale=scale, alpha=alpha)))
    held_out = chosen_frames(FRAMES, frames)[-HELD_OUT:]
    return Seen(path, alpha, held_out, [scene.rgb(frame).float() for frame in held_out])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("pictures", help="folder of pictures")
    parser.add_argument("--weights", default="cscsr_small_x4", help="weights to adapt; default: %(default)s")
    parser.add_argument("--teacher", default="cscsr_huge_long_noisy_x4", help="default: %(default)s")
    parser.add_argument("--noise", type=json.loads, help="noise of the sensor as JSON; default: as noisy_sensor.py")
    parser.add_argument("--alpha", type=float, default=0.25, help="light of a white pixel per clock; default: 0.25")
    parser.add_argument("--count", type=int, default=4, help="number of pictures, spread over the folder; default: 4")
    parser.add_argument("--steps", type=int, default=100, help="training steps; default: 100")
    args = parser.parse_args()
    without_chatter()
    noise = NOISE if args.noise is None else SensorNoise(**args.noise)
    teacher, found = Network.from_pretrained(args.teacher).eval(), folder_pictures(args.pictures)
    chosen = [found[n * len(found) // args.count] for n in range(args.count)]
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        longest = max(teacher.frames, Network.from_pretrained(args.weights).frames)
        shared = noise, args.alpha, teacher.scale, longest
        seen = [record(path, n, *shared, folder / f"{n}.npz") for n, path in enumerate(chosen)]
        for one, other in zip(seen, [*seen[1:], seen[0]], strict=True):
            student = Network.from_pretrained(args.weights).eval()
            student.noise_level = teacher.noise_level = one.clips(longest).noise_level
            before = one.psnr(student), other.psnr(student)
            examples = make_distillation_set(student, teacher, one.clips(longest))
            alike = fine_tune(student, examples, args.steps)
            after = one.psnr(student), other.psnr(student)
            rows.append([before[0], after[0], one.psnr(teacher), *alike, before[1], after[1]])
    rows.append(torch.tensor(rows).mean(0).tolist())
    names = [*(path.name for path in chosen), "mean"]
    head = ["", "before", "after", "teacher", "likeness before", "after", "other recording, before", "after"]
    lines = [[name, *(f"{value:.2f}" for value in row)] for name, row in zip(names, rows, strict=True)]
    print(table(head, lines))


if __name__ == "__main__":
    main()

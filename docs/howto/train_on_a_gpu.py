"""Train a network for films on one GPU: first on clips, then on films; in these the mixing of key frames, or all.

Processes make scenes and estimate their motion; the GPU keeps the latest of them and trains on each a few times, since
it takes more clips than they can make. A batch has single clips and clips of films, all turned at random.

    python docs/howto/train_on_a_gpu.py cscsr_huge_film_fast_x4 DIR --steps 0 --film-steps 4000 --all -o new.safetensors
"""

import argparse
import json
import math
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import multiprocessing as mp

from lightning_modules.data.loading import end_when_orphaned
from lightning_modules.data.pictures import folder_pictures
from lightning_modules.data.stills import StillClips
from lightning_modules.motion import ClassicalFlow
from lightning_modules.networks import RecurrentCSCSR
from lightning_modules.storage.pretrained import Weights, read_weights, settings_of, write_weights
from lightning_modules.tasks.muon import MuonWithAdam
from spikekit import SensorNoise

KEYS, PATTERN = 5, "RGGB"
#: by frames of a clip: clocks between key frames (0: a single clip), motion and bend of the scenes, share of a batch
SCENES = {
    41: [(0, 5, 1.5, 0.4), (8, 6, 1.2, 0.35), (20, 5, 0.8, 0.25)],
    101: [(0, 8, 1.5, 0.4), (8, 8, 1.5, 0.35), (20, 6, 0.8, 0.25)],
}
CYCLE = 0, 1, 0, 2  # kinds of scenes, as a process makes them one after the other


def clip_options(settings: dict, args: argparse.Namespace) -> list[dict]:
    """Return the arguments of StillClips for every kind of scene."""
    frames = settings["frames"]
    shared = {"scale": settings["scale"], "frames": frames, "flow_times": (5, frames - 6), "alpha": args.alpha}
    shared |= {"patch": args.patch, "rotation": 2.0, "brightness": tuple(args.brightness), "seed": args.seed}
    shared["noise"] = SensorNoise(**args.noise) if args.noise else None
    return [
        shared | {"key_frames": KEYS if every else 1, "every": every or 20, "motion": motion, "bend": bend}
        for every, motion, bend, _ in SCENES[frames]
    ]


def make_scenes(number: int, out: mp.Queue, pictures: list[Path], options: list[dict]) -> None:
    """Put scenes of all kinds into a queue, for ever: kind, spikes (K, N, h, w), truth and flows."""
    torch.set_num_threads(1)
    end_when_orphaned()
    estimate, kinds = ClassicalFlow(), [StillClips(pictures, **given) for given in options]
    index = number << 32
    while True:
        for kind in CYCLE:
            clip = kinds[kind][index]
            spikes, rgb = (clip[name].reshape(-1, *clip[name].shape[-3:]) for name in ("spikes", "rgb"))
            spikes = spikes.reshape(len(rgb), -1, *spikes.shape[-2:])
            frames = spikes.shape[1]
            flow = torch.stack(estimate(spikes, (5, frames // 2, frames - 6), PATTERN), dim=1)
            out.put((kind, *(part.numpy() for part in (spikes, rgb.half(), flow.half()))))
            index += 1


class Kept:
    """The latest scenes of one kind, on the device."""

    def __init__(self, most: int, device: str) -> None:
        self.most, self.device, self.made, self.parts = most, device, 0, []
        # a stream of its own: a scene does not wait for the steps that the GPU has yet to take
        self.stream = torch.cuda.Stream() if device == "cuda" else None

    def add(self, *parts: np.ndarray) -> None:
        """Keep a scene in place of the oldest."""
        new = [torch.from_numpy(part) for part in parts]
        self.parts = self.parts or [part.new_empty(self.most, *part.shape, device=self.device) for part in new]
        with torch.cuda.stream(self.stream):
            for kept, part in zip(self.parts, new, strict=True):
                kept[self.made % self.most].copy_(part)
            if self.stream:
                self.stream.synchronize()
        self.made += 1

    def draw(self, count: int, rng: np.random.Generator, film: bool) -> list[torch.Tensor]:
        """Spikes, truth and flows of so many scenes (B, K, ...), or of one clip of each (B, ...)."""
        scenes = rng.integers(min(self.made, self.most), size=count)
        clips = () if film else (rng.integers(self.parts[0].shape[1], size=count),)
        return [kept[scenes, *clips] for kept in self.parts]


def turned(spikes, rgb, flow, rng):
    """Backwards in time or transposed, neither of which changes the Bayer phase RGGB; light as float32."""
    if rng.uniform() < 0.5:
        films = [1] if spikes.ndim == 5 else []
        spikes, rgb, flow = spikes.flip([*films, -3]), rgb.flip(films), flow.flip([*films, -4])
    if rng.uniform() < 0.5:
        spikes, rgb, flow = spikes.mT, rgb.mT, flow.mT.flip(-3)
    return spikes, rgb.float(), flow.float()


def widened(source: str, alpha: float, **sizes: int | None) -> RecurrentCSCSR:
    """Return the network of some weights, wider or deeper, but with the same pictures.

    Nothing hears the new channels yet, and new residual blocks change nothing.
    """
    weights = read_weights(source)
    settings = {name: value for name, value in weights.settings.items() if name != "class"}
    sizes = {name: size for name, size in sizes.items() if size}
    network = RecurrentCSCSR(**settings | {"alpha": alpha} | sizes, steps=0)
    state = network.state_dict()
    for name, new in state.items():
        old = weights.tensors.get(name)
        if old is None:
            if ".body.2." in name:  # the last convolution of a residual block
                new.zero_()
            continue
        if new.shape != old.shape:
            new[: len(old)] = 0
        new[tuple(slice(side) for side in old.shape)] = old.float()
    network.load_state_dict(state)
    network.scale_picture(settings["alpha"] / alpha)
    return network


def save(network: RecurrentCSCSR, path: str) -> None:
    """Write the weights in half precision."""
    tensors = {name: value.cpu().half() for name, value in network.state_dict().items()}
    write_weights(Weights(Path(path), settings_of(network), {}, tensors), path)


def train(parameters, loss_of, steps, seconds, lr, what, keep) -> None:
    """Take so many steps, or as many as there is time for; the rate rises over a hundred and falls along a cosine."""
    optimizer, mean, start, n = MuonWithAdam(parameters, lr=lr), None, time.monotonic(), 0
    while n < steps and (share := max(n / steps, (time.monotonic() - start) / seconds)) < 1:
        for group in optimizer.param_groups:
            group["lr"] = lr * (0.503 + 0.5 * math.cos(math.pi * share)) * min(1, (n + 1) / 100)
        loss = loss_of()
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        mean = loss.detach() if mean is None else mean.lerp(loss.detach(), 0.02)
        n += 1
        if not n % 100 or n == steps:
            print(f"{what}: {n} of {steps} steps, {time.monotonic() - start:.0f} s, loss {mean:.5f}", flush=True)
        if not n % 500:
            keep()
    print(f"{what}: {n} steps, {time.monotonic() - start:.0f} s")


def main() -> None:
    """Train, and write the weights."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", help="of a network for films to begin with: a name of the package, or a file")
    parser.add_argument("pictures", type=Path, help="folder of training pictures")
    parser.add_argument("-o", "--output", default="new.safetensors")
    parser.add_argument("--steps", type=int, default=4300, help="of clips")
    parser.add_argument("--film-steps", type=int, default=500, help="of films")
    parser.add_argument("--all", action="store_true", help="films, and some single clips with them, train all weights")
    parser.add_argument("--minutes", type=float, default=math.inf, help="that the steps on films may take")
    parser.add_argument("--width", type=int, help="channels where the colours are one, instead of those of the weights")
    parser.add_argument("--fusion-blocks", type=int, help="residual blocks where key frames meet, likewise")
    parser.add_argument("--batch", type=int, default=24, help="clips in a step, singly or in films")
    parser.add_argument("--patch", type=int, default=48, help="side of a clip in sensor pixels")
    parser.add_argument("--lr", type=float, default=5e-4)
    parser.add_argument("--alpha", type=float, default=0.6)
    parser.add_argument("--brightness", type=float, nargs=2, default=(0.3, 1.2))
    parser.add_argument(
        "--noise", type=json.loads, help="of the sensor, such as '{\"photons\": 3000}'; a random share of it"
    )
    parser.add_argument("--workers", type=int, default=12, help="processes that make scenes")
    parser.add_argument("--kept", type=int, default=6000, help="scenes of each kind on the GPU")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    torch.manual_seed(args.seed)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    network = widened(args.weights, args.alpha, end_width=args.width, fusion_blocks=args.fusion_blocks)
    if network.config.frames not in SCENES or network.pattern != PATTERN:
        got = f"{network.config.frames} and {network.pattern}"
        parser.error(f"weights: expected those of clips of 41 or 101 frames, behind {PATTERN}, got {got}")
    options = clip_options(network.settings, args)
    context = mp.get_context("spawn")
    queue, pictures = context.Queue(4 * args.workers), folder_pictures(args.pictures)
    for number in range(args.workers):
        context.Process(target=make_scenes, args=(number, queue, pictures, options), daemon=True).start()
    kinds = SCENES[network.config.frames]
    kept = [Kept(args.kept, device) for _ in kinds]

    def keep() -> None:
        while True:
            kind, *parts = queue.get()
            kept[kind].add(*parts)

    threading.Thread(target=keep, daemon=True).start()
    network.to(device).to(memory_format=torch.channels_last)
    torch.backends.cudnn.benchmark = True
    torch.set_float32_matmul_precision("high")
    rng = np.random.default_rng(args.seed)
    while min(scenes.made for scenes in kept) < min(40, args.batch):
        time.sleep(0.2)

    def loss_of_clips():
        counts = [max(1, round(args.batch * share)) for *_, share in kinds]
        parts = [scenes.draw(count, rng, film=False) for scenes, count in zip(kept, counts, strict=True)]
        spikes, rgb, flow = turned(*map(torch.cat, zip(*parts, strict=True)), rng)
        with torch.autocast(device, torch.bfloat16):
            return F.l1_loss(network(spikes, flow), rgb)

    def loss_of_films():
        kind = int(rng.integers(1, len(kinds)))
        spikes, rgb, flow = turned(*kept[kind].draw(max(1, args.batch // KEYS), rng, film=True), rng)
        future = (KEYS - 1) * int(rng.integers(2))
        with torch.autocast(device, torch.bfloat16):
            films = network.film(spikes, flow, every=kinds[kind][0], future=future)
        if not future:
            return F.l1_loss(films[0][:, 1:], rgb[:, 1:])
        return (F.l1_loss(films[0][:, :-1], rgb[:, :-1]) + F.l1_loss(films[1], rgb)) / 2

    def loss_of_all():
        spikes, rgb, flow = turned(*kept[0].draw(max(1, args.batch // KEYS), rng, film=False), rng)
        with torch.autocast(device, torch.bfloat16):
            return F.l1_loss(network(spikes, flow), rgb) / 2 + loss_of_films()

    film_loss = loss_of_all if args.all else loss_of_films
    parts = ("clips", loss_of_clips, args.steps, math.inf), ("films", film_loss, args.film_steps, 60 * args.minutes)
    for what, loss_of, steps, seconds in parts:
        for name, parameter in network.named_parameters():
            parameter.requires_grad_(name.startswith("fusion.") == (what == "films") or (what == "films" and args.all))
        learning = [p for p in network.parameters() if p.requires_grad]
        train(learning, loss_of, steps, seconds, args.lr, what, partial(save, network, args.output))
    print("scenes made:", [scenes.made for scenes in kept])
    save(network, args.output)


if __name__ == "__main__":
    main()

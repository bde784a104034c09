"""Measure the effect of errors in the flows of the four sub-streams, for the three fusions of Table 3: J, D and E.

``python benchmarks/flow_noise.py VID4`` prints the table. ``ClassicalFlow`` estimates the flow of every sub-stream
separately, and normal noise is added. The flows are then averaged by eq. (7) (J), averaged by colour (D), or
interleaved (E).
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from statistics import mean

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor

from lightning_modules.data import FilmScenes
from lightning_modules.motion import ClassicalFlow, MotionEstimator
from lightning_modules.networks import CSCSR
from spikekit import psnr
from spikekit.tables import table

FUSIONS = {"J": "joint", "D": "independent", "E": "assembled"}


class NoisyFlow(MotionEstimator):
    """``ClassicalFlow`` of the sub-streams, with noise; caches the flows of the last clip.

    Args:
        smooth: standard deviation, in pixels of a sub-stream, of the blur of the noise; 0 for independent pixels.

    Attributes:
        noise: standard deviation, in sensor pixels, of each component at the first and the last time point.
    """

    def __init__(self, smooth: float = 0.0) -> None:
        super().__init__()
        self.smooth, self.noise = smooth, 0.0
        self._clip, self._flows = torch.empty(0), ()

    def channel_flows(self, spikes: Tensor, times: tuple[int, int, int], pattern: str) -> tuple[Tensor, Tensor]:
        if not (self._clip.shape == spikes.shape and self._clip.equal(spikes)):
            self._clip, self._flows = spikes, ClassicalFlow().channel_flows(spikes, times, pattern)
        generator = torch.Generator().manual_seed(0)
        return tuple(flow + self._errors(flow, generator) for flow in self._flows)

    def _errors(self, flow: Tensor, generator: torch.Generator) -> Tensor:
        errors = torch.randn(flow.shape, generator=generator)
        if self.smooth:
            side = 2 * round(3 * self.smooth) + 1
            sigma = self.smooth, self.smooth
            errors = gaussian_blur2d(errors.flatten(0, 1), (side, side), sigma, "circular").reshape(flow.shape)
            errors = errors / errors.std()
        return errors * self.noise / 2  # in Bayer cells


@torch.inference_mode()
def measure(
    weights: str, clips: list[dict[str, Tensor]], noises: list[float], smooth: float = 0.0
) -> dict[float, dict[str, float]]:
    """Return the mean PSNR over clips by noise, in sensor pixels, and by fusion."""
    motion = NoisyFlow(smooth)
    networks = {
        letter: CSCSR.from_pretrained(weights, motion=motion, motion_fusion=fusion)
        for letter, fusion in FUSIONS.items()
    }
    scores: dict[float, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for clip in clips:
        for motion.noise in noises:
            for letter, network in networks.items():
                rgb = network(clip["spikes"][None].float())[0].clamp(0, 1)
                scores[motion.noise][letter].append(psnr(rgb, clip["rgb"]).item())
    return {noise: {letter: mean(of) for letter, of in row.items()} for noise, row in scores.items()}


def main(args: list[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("films", help="folder of films, such as that of Vid4")
    parser.add_argument("--weights", default="cscsr_small_x4")
    parser.add_argument("--noises", type=float, nargs="+", default=[0, 0.5, 1, 1.5, 2, 3], metavar="PIXELS")
    parser.add_argument("--smooth", type=float, default=0.0, metavar="PIXELS", help="blur of the noise (default: none)")
    asked = parser.parse_args(args)
    settings = CSCSR.from_pretrained(asked.weights).settings
    data = FilmScenes(asked.films, **{name: settings[name] for name in ("scale", "frames", "alpha", "pattern")})
    data.setup("test")
    clips = [data.test_set[n] for n in range(len(data.test_set))]
    rows = measure(asked.weights, clips, asked.noises, asked.smooth)
    lines = [[f"{noise:g}", *(f"{of[name]:.2f}" for name in FUSIONS)] for noise, of in rows.items()]
    print(table(["noise (px)", *FUSIONS], lines))


if __name__ == "__main__":
    main()

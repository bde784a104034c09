"""Error and time of ClassicalFlow and of scikit-image's TV-L1: ``python benchmarks/motion.py``.

The scenes have known flow; the estimators are timed in turn, in one process.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
import torch
from in_turn import interleave, ratio
from torch import Tensor

from lightning_modules.data import StillScenes
from lightning_modules.motion import ClassicalFlow, ZeroFlow
from spikekit.tables import table
from spikekit.timing import cpu_name, software, timer_of


class ScikitImage(ClassicalFlow):
    """TV-L1 of scikit-image on the same pictures: a flow for each half of the clip, and their mean."""

    def _velocities(self, pictures: Tensor, clock: Tensor, attachment: Tensor) -> Tensor:
        from skimage.registration import optical_flow_tvl1

        found = []
        for before, middle, after in pictures.numpy():
            flows = [
                optical_flow_tvl1(middle, other, attachment=30, tol=0.01, dtype=np.float32)[::-1] / away
                for other, away in ((before, float(clock[0] - clock[1])), (after, float(clock[2] - clock[1])))
            ]
            found.append(np.stack([sum(flows) / 2] * 2))
        return torch.from_numpy(np.stack(found)).float()


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", type=int, default=12, help="scenes")
    parser.add_argument("--patch", type=int, default=48, help="side of a scene, in sensor pixels")
    parser.add_argument("--motion", type=float, default=3.0, help="largest motion, in sensor pixels")
    parser.add_argument("--alpha", type=float, default=0.4, help="spikes per frame of a white pixel")
    parser.add_argument("--frames", type=int, default=41, help="frames of a clip")
    parser.add_argument("--root", help="folder of pictures; default: held-out ones of scikit-image")
    parser.add_argument("--rounds", type=int, default=5, help="timings of each")
    args = parser.parse_args(arguments)
    times = 5, args.frames // 2, args.frames - 6
    data = StillScenes(
        val_root=args.root,
        val_patch=args.patch,
        val_clips=args.clips,
        frames=args.frames,
        flow_times=times[::2],
        alpha=args.alpha,
        motion=args.motion,
        workers=0,
    )
    data.setup()
    clips = [data.val_set[index] for index in range(args.clips)]
    estimators = {
        "ClassicalFlow": ClassicalFlow(),
        "5 warps": ClassicalFlow(warps=5),
        "1 warp": ClassicalFlow(warps=1),
        "scikit-image's TV-L1": ScikitImage(),
        "no motion": ZeroFlow(),
    }
    runs = {
        name: lambda flow=flow: [torch.cat(flow(clip["spikes"][None], times, data.val_set.pattern)) for clip in clips]
        for name, flow in estimators.items()
    }
    threads = torch.get_num_threads()
    timer, counted = timer_of(torch.device("cpu"), threads)
    taken = interleave(runs, args.rounds, timer)
    print(f"machine  {cpu_name()}, {threads} threads, {counted}, {args.rounds} rounds\n{software()}")
    lines = []
    for name, run in runs.items():
        errors = [(got - clip["flow"]).norm(dim=1).mean().item() for got, clip in zip(run(), clips, strict=True)]
        times_as_long = ratio(taken[name], taken["ClassicalFlow"])
        spread = f"{times_as_long.median:.2f} ({times_as_long.least:.2f} to {times_as_long.most:.2f})"
        milliseconds = 1000 * float(np.median(taken[name])) / len(clips)
        lines.append([name, f"{sum(errors) / len(errors):.3f}", f"{milliseconds:.1f}", spread])
    print("\n" + table(["estimator", "end-point error (px)", "ms per clip", "time, ratio"], lines))


if __name__ == "__main__":
    main()

"""``python -m lightning_modules.data``: how long a clip takes to make, on one thread."""

import time

import torch

from lightning_modules.data import StillScenes


def main(clips: int = 20) -> None:
    """Print the median time of a clip for two patch sizes, on the embedded scenes."""
    torch.set_num_threads(1)
    for patch in (24, 96):
        data = StillScenes(patch=patch, workers=0)
        data.setup()
        seconds = []
        for index in range(clips + 3):
            begin = time.perf_counter()
            data.train_set[index]
            seconds.append(time.perf_counter() - begin)
        median = sorted(seconds[3:])[clips // 2]  # the first ones read their pictures from disk
        print(f"{patch} x {patch} sensor pixels, x4, 41 clocks: {1000 * median:.0f} ms a clip")  # noqa: T201


if __name__ == "__main__":
    main()

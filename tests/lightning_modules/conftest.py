import multiprocessing
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from skimage import io

from lightning_modules.__main__ import main


@pytest.fixture
def configs():
    """The folder of configurations, which is not part of the installed packages."""
    return Path(__file__).parents[2] / "configs"


@pytest.fixture(name="forked")
def _forked():
    """``lightning`` in a process of its own, which has imported all that this one has; another would take seconds."""

    def quietly(words, environment):
        os.environ.update(environment)
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 1)
        os.dup2(nothing, 2)
        main([*map(str, words)])

    def start(words, **environment):
        process = multiprocessing.get_context("fork").Process(target=quietly, args=(words, environment))
        process.start()
        return process

    return start


@pytest.fixture(name="convolutions")
def _convolutions(monkeypatch):
    """Every convolution that runs, as (multiplications, whether its input has a gradient)."""
    seen, run = [], torch.nn.functional.conv2d

    def conv2d(x, weight, *args, **options):
        output = run(x, weight, *args, **options)
        seen.append((weight[0].numel() * output.numel(), x.requires_grad))
        return output

    monkeypatch.setattr(torch.nn.functional, "conv2d", conv2d)
    return seen


@pytest.fixture
def write_film():
    """A disc that moves over noise by a pixel a frame."""

    def write(folder, count, size=(32, 48), name="{:08d}.png", seed=0, first=0):
        folder.mkdir(parents=True, exist_ok=True)
        rng = np.random.default_rng([seed, len(str(folder))])
        ground = rng.integers(40, 160, (*size, 3), "uint8")
        y, x = np.mgrid[: size[0], : size[1]]
        for n in range(first, first + count):
            picture = ground.copy()
            picture[(y - size[0] / 2) ** 2 + (x - 10 - n) ** 2 < 36] = 230
            io.imsave(folder / name.format(n), picture, check_contrast=False)

    return write


@pytest.fixture
def reds(write_film):
    def write(root, train="train/train_orig", val="val/val_orig", scenes=(2, 1), count=9):
        for split, there in ((train, scenes[0]), (val, scenes[1])):
            for scene in range(there):
                write_film(root / split / f"{scene:03d}", count, seed=scene)

    return write


@pytest.fixture
def septuplets(write_film):
    def write(root, names, folder="sequences", size=(64, 96), frames=range(1, 8)):
        for seed, name in enumerate(names):
            write_film(root / folder / name, len(frames), size, "im{}.png", seed, frames[0])

    return write

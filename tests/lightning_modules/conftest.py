import multiprocessing
import os
import socket
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


@pytest.fixture(name="in_two_processes")
def _in_two_processes(forked):
    """A run of two processes, which are told of each other as Lightning, or a cluster, tells those that it starts."""

    def run(words):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = str(free.getsockname()[1])
        words = [*words, "--trainer.devices", 2, "--trainer.strategy", "ddp"]
        address = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
        for process in [forked(words, LOCAL_RANK=str(rank), **address) for rank in range(2)]:
            process.join()
            assert process.exitcode == 0

    return run


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


def _write_film(folder, count, size=(32, 48), name="{:08d}.png", seed=0, first=0):
    """A disc that moves over noise by a pixel a frame."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([seed, len(str(folder))])
    ground = rng.integers(40, 160, (*size, 3), "uint8")
    y, x = np.mgrid[: size[0], : size[1]]
    for n in range(first, first + count):
        picture = ground.copy()
        picture[(y - size[0] / 2) ** 2 + (x - 10 - n) ** 2 < 36] = 230
        io.imsave(folder / name.format(n), picture, check_contrast=False)


@pytest.fixture(name="write_film")
def _write_film_fixture():
    return _write_film


def _write_pan(folder, speed, size=(128, 192)):
    """Three frames of a picture that goes to the right."""
    folder.mkdir(parents=True)
    picture = np.random.default_rng(0).integers(0, 256, (40, 60, 3), "uint8").repeat(4, 0).repeat(4, 1)
    for n in range(3):
        left = 20 - speed * n
        io.imsave(folder / f"{n}.png", picture[: size[0], left : left + size[1]], check_contrast=False)


@pytest.fixture(name="write_pan")
def _write_pan_fixture():
    return _write_pan


def _reds(root, train="train/train_orig", val="val/val_orig", scenes=(2, 1), count=9):
    for split, there in ((train, scenes[0]), (val, scenes[1])):
        for scene in range(there):
            _write_film(root / split / f"{scene:03d}", count, seed=scene)


@pytest.fixture(name="reds")
def _reds_fixture():
    return _reds


def _septuplets(root, names, folder="sequences", size=(64, 96), frames=range(1, 8)):
    for seed, name in enumerate(names):
        _write_film(root / folder / name, len(frames), size, "im{}.png", seed, frames[0])


@pytest.fixture(name="septuplets")
def _septuplets_fixture():
    return _septuplets

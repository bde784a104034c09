"""Modules that are imported are counted, not the time that it takes."""

import subprocess
import sys

import pytest

ASIDE = """
import sys
from lightning_modules import SuperResolution
import torch
from lightning_modules.networks import CSCSR
picture = SuperResolution.from_pretrained(4, "balanced")(torch.ones(1, 41, 16, 16))
print(*sys.modules)
"""

AFTERWARDS = """
import lightning_modules.tasks, torch, scipy.signal
from pytorch_lightning.utilities.compile import OptimizedModule
linear = torch.nn.Linear(1, 1)
assert not isinstance(linear, OptimizedModule)
assert isinstance(torch.compile(linear), OptimizedModule)
assert torch._dynamo.OptimizedModule is not OptimizedModule
assert len(scipy.signal.windows.hamming(3)) == 3
import torch._dynamo.config
import matplotlib
from torchmetrics import MeanMetric
metric = MeanMetric()
metric.update(1.0)
matplotlib.use("Agg")
assert metric.plot()[0].axes
"""


def run(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def test_a_picture_takes_neither_a_compiler_nor_signals():
    imported = set(run(ASIDE).split())
    assert "pytorch_lightning" in imported
    assert (
        not {"torch._dynamo", "scipy.signal", "scipy.stats", "sympy", "tensorboard", "skimage", "matplotlib"} & imported
    )
    assert len(imported) < 3000


@pytest.mark.slow
def test_what_was_left_out_is_there_afterwards():
    run(AFTERWARDS)

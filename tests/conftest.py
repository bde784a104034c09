"""Where tests run side by side (pytest -n), each has one thread, and so do the commands that it starts."""

import os

import torch

if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)

import warnings
from contextlib import contextmanager

import pytest
import torch
from hypothesis import settings

settings.register_profile("spikekit", deadline=None, derandomize=True, database=None, max_examples=40)
settings.load_profile("spikekit")


@pytest.fixture(name="without_kernels")
def _without_kernels():
    """Context in which custom operators use their torch path on the CPU."""

    @contextmanager
    def without_kernels(*operators):
        with torch.library._scoped_library("spikekit", "IMPL") as library, warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that kernels are overridden, once
            for op in operators:
                library.impl(op._name, op._init_fn, "CPU", allow_override=True)
            yield

    return without_kernels

import sys

import numpy as np
import pytest
import torch

from spikekit.timing import peak_memory


@pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read from /proc")
def test_peak_memory_includes_freed_and_returned_tensors():
    def passing():
        np.ones(16 << 20, np.uint8)
        return torch.ones(4 << 20, dtype=torch.uint8)

    np.ones(256 << 20, np.uint8)  # an earlier peak, higher than the one to measure
    device = torch.device("cpu")
    assert 15 <= peak_memory(passing, device) <= 24
    assert peak_memory(lambda: torch.ones(64 << 20, dtype=torch.uint8), device) >= 63

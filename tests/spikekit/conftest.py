import pytest
import torch
from hypothesis import settings

settings.register_profile("spikekit", deadline=None, derandomize=True, database=None, max_examples=40)
settings.load_profile("spikekit")


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)

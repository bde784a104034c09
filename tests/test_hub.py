"""The entry points of ``torch.hub``."""

from pathlib import Path

import torch

from lightning_modules import list_models

ROOT = str(Path(__file__).parents[1])


def test_every_network_is_an_entry_point(monkeypatch):
    monkeypatch.syspath_prepend(ROOT)
    import hubconf

    names = [weights.name for weights in list_models() if weights.scale]
    assert all(callable(getattr(hubconf, name)) for name in names)
    assert torch.hub.load(ROOT, "cscsr_tiny_x4", source="local").scale == 4

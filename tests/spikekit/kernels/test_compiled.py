"""Compilation and caching of loops by Numba."""

import pytest

pytest.importorskip("numba")

from numba import config

from spikekit.kernels.compiled import compiled


def test_loops_compile_on_a_full_disk(full_disk, tmp_path, monkeypatch):
    def loop(x):
        return x + 1

    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    with full_disk(0):
        assert compiled(loop)(1) == 2
    assert not list(tmp_path.rglob("*.nbc"))
    assert compiled(loop)(1) == 2
    assert list(tmp_path.rglob("*.nbc"))  # where there is room the next process finds it

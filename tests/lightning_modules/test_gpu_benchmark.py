"""The script that measures a GPU runs whole, so that none of a card's minutes goes by in mending it."""

import csv
import runpy
import sys

import pytest


@pytest.mark.slow
def test_everything_is_measured_once(request, tmp_path, monkeypatch):
    script = str(request.config.rootpath / "benchmarks" / "gpu.py")
    monkeypatch.setattr(sys, "argv", [script, "--short", "-o", str(tmp_path / "gpu.csv")])
    runpy.run_path(script, run_name="__main__")
    with open(tmp_path / "gpu.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    measured = {row["what"].split(",")[0] for row in rows}
    assert measured >= {"scenes", "motion", "training", "network", "motion and network", "integrate and fire", "tfi"}
    assert all(0 < float(row["seconds"]) < 300 for row in rows)

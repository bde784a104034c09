"""The script that measures a GPU runs whole, so that none of a card's minutes goes by in mending it."""

import csv
import subprocess
import sys

import pytest


@pytest.mark.slow
def test_everything_is_measured_once(request, tmp_path):
    script = request.config.rootpath / "benchmarks" / "gpu.py"
    command = [sys.executable, str(script), "--short", "-o", str(tmp_path / "gpu.csv")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    with open(tmp_path / "gpu.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    measured = {row["what"].split(",")[0] for row in rows}
    assert measured >= {"scenes", "motion", "training", "network", "motion and network", "integrate and fire", "tfi"}
    assert all(0 < float(row["seconds"]) < 300 for row in rows)

"""What CUDA would find without a GPU: code that mixes tensors of two devices, or makes one on the wrong one."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
CASES = [HERE / f"{name}.py" for name in ("operators", "networks")]


@pytest.mark.slow
def test_nothing_is_computed_on_the_wrong_device():
    # in a process of its own: PyTorch takes up such a device for good
    folders = (folder for beside in ("spikekit", "lightning_modules") for folder in (HERE.parent / beside).rglob(""))
    path = os.pathsep.join([str(HERE), *map(str, folders), *filter(None, [os.environ.get("PYTHONPATH")])])
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "--noconftest", *map(str, CASES)],
        env={**os.environ, "PYTHONPATH": path},
        cwd=HERE.parents[1],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-2000:]

"""What CUDA would find without a GPU: code that mixes tensors of two devices, or makes one on the wrong one."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent


@pytest.mark.slow
@pytest.mark.parametrize(("cases", "beside"), [("operators", "spikekit"), ("networks", "lightning_modules")])
def test_on_another_device(cases, beside):
    # in a process of its own: PyTorch takes up such a device for good
    path = os.pathsep.join(
        [str(HERE), *map(str, (HERE.parent / beside).rglob("")), *filter(None, [os.environ.get("PYTHONPATH")])]
    )
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "--noconftest", str(HERE / f"{cases}.py")],
        env={**os.environ, "PYTHONPATH": path},
        cwd=HERE.parents[1],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-2000:]

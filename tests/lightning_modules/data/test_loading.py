"""Loading of clips."""

import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from lightning_modules.data.loading import FreshClips

# A clip is larger than a pipe: its worker waits for somebody to take it.
LOAD = """
import os, torch
from lightning_modules.data.loading import load_clips
class Clips(torch.utils.data.Dataset):
    def __len__(self): return 100
    def __getitem__(self, index): return dict(pid=torch.tensor(os.getpid()), rgb=torch.zeros(1 << 20))
clips = iter(load_clips(Clips(), 1, 2))
print(*set(int(next(clips)["pid"]) for _ in range(8)), flush=True)
input()
"""


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no such signals")
def test_workers_end_with_a_killed_run():
    process = subprocess.Popen([sys.executable, "-c", LOAD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    workers = [int(pid) for pid in process.stdout.readline().split()]
    assert len(workers) == 2
    assert all(map(alive, workers))
    process.send_signal(signal.SIGKILL)
    process.wait()
    for _ in range(120):
        if not any(map(alive, workers)):
            break
        time.sleep(0.5)
    assert not any(map(alive, workers))


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals")
def test_processes_end_with_the_first():
    started = """
from lightning_modules.cli import command
command.run(None, lambda *_, **__: print("begun", flush=True) or input())
"""
    first = """
import os, subprocess, sys
from lightning_modules.cli import command
command.run(None, lambda *_, **__: None)
subprocess.run([sys.executable, "-c", sys.argv[1]], env=dict(os.environ, LOCAL_RANK="1"))
"""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    earlier = {**os.environ, "SPIKEKIT_FIRST_PROCESS": str(os.getpid())}  # as a run in this process would leave it
    with subprocess.Popen([sys.executable, "-c", first, started], env=earlier, **pipes) as process:
        assert process.stdout.readline() == "begun\n"
        process.send_signal(signal.SIGKILL)
        assert process.stdout.read() == ""  # the pipe ends with the last process that holds it


def of_process(rank, processes, step=0, accumulated=1):
    trainer = SimpleNamespace(
        global_rank=rank, world_size=processes, global_step=step, accumulate_grad_batches=accumulated
    )
    return SimpleNamespace(trainer=trainer)


def test_processes_see_every_training_clip_once():
    alone = [*FreshClips(of_process(0, 1), 4, 13)]
    assert alone == [*range(12)]
    shares = [[*FreshClips(of_process(rank, 2), 2, 13)] for rank in range(2)]
    assert shares == [[0, 1, 4, 5, 8, 9], [2, 3, 6, 7, 10, 11]]
    assert [len(FreshClips(of_process(rank, 2), 2, 13)) for rank in range(2)] == [6, 6]
    later = [index for rank in range(2) for index in FreshClips(of_process(rank, 2, step=3, accumulated=2), 2, 13)]
    assert sorted(later) == [*range(24, 36)]
    assert [*FreshClips(SimpleNamespace(trainer=None), 4, 13)] == alone
    with pytest.raises(ValueError, match="batch_size: 2 x 3 processes need 6 clips, got 5"):
        FreshClips(of_process(0, 3), 2, 5)

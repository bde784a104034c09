"""Loading of clips."""

import multiprocessing
import os
import signal
import sys
import time
from types import SimpleNamespace

import pytest
import torch
from pytorch_lightning.utilities import rank_zero_only

from lightning_modules.cli import command
from lightning_modules.data.loading import FreshClips, load_clips

FORK = multiprocessing.get_context("fork") if sys.platform != "win32" else None


class Clips(torch.utils.data.Dataset):
    """Clips larger than a pipe: a worker waits for somebody to take them."""

    def __len__(self):
        return 100

    def __getitem__(self, index):
        return {"pid": torch.tensor(os.getpid()), "rgb": torch.zeros(1 << 20)}


def killed(start):
    """Kill a process once it has sent something; return that, and whether all processes it started have ended."""
    there, here = FORK.Pipe(duplex=False)
    process = FORK.Process(target=start, args=(here,))
    process.start()
    here.close()
    sent = there.recv()
    process.kill()
    process.join()
    return sent, there.poll(60)  # the pipe ends with the last process that holds it


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no such signals")
def test_workers_end_with_a_killed_run():
    def load(pipe):
        clips = iter(load_clips(Clips(), 1, 2))
        pipe.send({int(next(clips)["pid"]) for _ in range(8)})
        time.sleep(600)

    workers, ended = killed(load)
    for pid in () if ended else workers:
        os.kill(pid, signal.SIGKILL)
    assert (len(workers), ended) == (2, True)


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals")
def test_processes_end_with_the_first(monkeypatch):
    monkeypatch.setenv("SPIKEKIT_FIRST_PROCESS", str(os.getpid()))  # as a run in this process would leave it

    def last(pipe):
        rank_zero_only.rank = 1
        command.run(None, lambda *_: [pipe.send("begun"), time.sleep(90)])

    def first(pipe):
        command.run(None, lambda *_: None)
        started = FORK.Process(target=last, args=(pipe,))
        started.start()
        started.join()

    assert killed(first) == ("begun", True)


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

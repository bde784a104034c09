"""Every operator in long runs, with several threads, and called from several threads: same bits, bounded memory.

The environment variable SPIKEKIT_FUZZ=N sets the number of calls.
"""

import os
import resource
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from operator_examples import EXAMPLES


def names(example):
    return example.name


def equal(some, others):
    return all(a.equal(b) for a, b in zip(some, others, strict=True))


@pytest.fixture(name="threads")
def _threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("example", EXAMPLES, ids=names)
def test_more_threads_give_the_same_bits(example, threads):
    inputs = [tensor.float() for tensor in example.tensors((2,), (96, 128))]
    threads(1)
    alone = example.results(*inputs)
    threads(2)
    assert equal(example.results(*inputs), alone)


@pytest.fixture(name="hasty")
def _hasty():
    """Switch threads as often as possible."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.mark.parametrize("example", EXAMPLES, ids=names)
def test_several_threads_do_not_disturb_each_other(example, hasty):
    """Even in caches, with different sizes in every thread."""
    inputs = [[t.float() for t in example.tensors((2,), (12 + 2 * n, 30 - 2 * n), seed=n)] for n in range(8)]
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda n: example.results(*inputs[n % 8]), range(32)))
    alone = [example.results(*tensors) for tensors in inputs]
    assert all(equal(results, alone[n % 8]) for n, results in enumerate(found))


def test_memory_stays_flat():
    """Long runs of all operators in turn, with their caches."""
    rounds = int(os.environ.get("SPIKEKIT_FUZZ", "100"))
    inputs = [[tensor.float() for tensor in example.tensors((2,), (8, 12))] for example in EXAMPLES]

    def calls(count):
        for _ in range(count):
            for example, tensors in zip(EXAMPLES, inputs, strict=True):
                example.results(*tensors)
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10

    before = calls(20)
    results = [
        result for example, tensors in zip(EXAMPLES, inputs, strict=True) for result in example.results(*tensors)
    ]
    # one result of each kept at every call would be more
    assert calls(rounds) - before < min(rounds * sum(result.nbytes for result in results) // 4, 16 << 20)

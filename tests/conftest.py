"""The option of the device; one thread each where tests run side by side (pytest -n); what damages files."""

import atexit
import copy
import gc
import multiprocessing
import os
import random
import resource
import signal
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest

gc.disable()  # until all is imported and collected, of which nothing is garbage

if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ["OMP_NUM_THREADS"] = "1"  # before torch is imported


def pytest_configure(config):
    """Programs that tests start hear Ctrl-C, also where the shell runs tests in the background and ignores it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(config, "workerinput"):  # of pytest -n: what it leaves need not be collected
        atexit.register(os._exit, 0)
    if config.getoption("--table") and config.getoption("numprocesses", None):
        raise pytest.UsageError("--table: expected a single process, got -n")


def pytest_addoption(parser):
    parser.addoption("--device", default="cpu", help="where operators are tested: cpu, cuda; default cpu")
    parser.addoption("--table", metavar="FILE", help="CSV file for the rows of tests/extremes")


@pytest.fixture(autouse=True)
def _seed():
    import torch  # here and below, as the process that only distributes tests needs none of it

    torch.manual_seed(0)


@pytest.fixture(scope="session")
def device(request):
    import torch

    return torch.device(request.config.getoption("device"))


def pytest_collection_finish():
    """The garbage collector need not look through thousands of tests and all that they import, nor as often."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 100)
    gc.enable()


def pytest_sessionfinish():
    gc.unfreeze()


def pytest_collection_modifyitems(items):
    """Fuzzing at length takes as long as it takes."""
    if "SPIKEKIT_FUZZ" in os.environ:
        for item in items:
            item.add_marker(pytest.mark.timeout(0))


_ODD = (
    None, True, False, 0, -1, 1, 2, 2**31, 2**63, 10**400, -(10**30), 0.0, -0.5, 1e308, float("nan"), float("inf"),
    "", "a", "\n", "a\nb", "..", "os.system(command='false')", "\ud800", "9" * 5000, [], {}, [[]], [1, 2], [None],
    {"": ""}, {"class_path": "os.system"}, ["a"] * 1000, {"a": {"b": []}},
)  # fmt: skip


def damage(data: bytes, rng: random.Random) -> bytes:
    """Flip, cut, insert, repeat or swap bytes; twice and more, now and then."""
    data = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 8))):
        # headers lie at the beginning or, in archives, at the end
        end = len(data) if rng.random() < 0.5 else min(len(data), 200)
        start = len(data) - end if rng.random() < 0.3 else 0
        place, length = start + rng.randrange(end or 1), rng.choice((1, 1, 2, 4, 8, 30))
        part = slice(place, place + length)
        kind = rng.choice(("flip", "set", "set", "cut", "insert", "remove", "repeat", "swap"))
        if kind == "flip" and data:
            data[min(place, len(data) - 1)] ^= 1 << rng.randrange(8)
        elif kind == "set":
            data[part] = rng.choice((b"\0", b"\xff", b"\x7f", b"9", rng.randbytes(1))) * len(data[part])
        elif kind == "cut":
            del data[place:]
        elif kind == "insert":
            data[place:place] = rng.randbytes(length)
        elif kind == "remove":
            del data[part]
        elif kind == "repeat":
            data[place:place] = data[part] * rng.choice((1, 3, 100))
        elif kind == "swap":
            other = slice(other := rng.randrange(len(data) or 1), other + length)
            if place + length <= other.start < other.stop <= len(data):
                data[part], data[other] = data[other], data[part]
    return bytes(data)


def damage_values(value: object, rng: random.Random) -> object:
    """Put something odd in the place of a value, at any depth of lists and dictionaries; or leave out, or add one."""
    value, kind = copy.copy(value), rng.random()
    if not isinstance(value, dict | list) or not value or kind < 0.1:
        return rng.choice(_ODD)
    key = rng.choice(list(value)) if isinstance(value, dict) else rng.randrange(len(value))
    if kind < 0.2:
        del value[key]
    elif kind < 0.25 and isinstance(value, dict):
        value[rng.choice(("odd", "a\nb", ""))] = rng.choice(_ODD)
    else:
        value[key] = damage_values(value[key], rng)
    return value


def seeds(cases: int) -> range:
    """Return a seed for every case: SPIKEKIT_FUZZ says how many there are instead, SPIKEKIT_FUZZ_SEED the first."""
    first = int(os.environ.get("SPIKEKIT_FUZZ_SEED", "0"))
    return range(first, first + int(os.environ.get("SPIKEKIT_FUZZ", cases)))


@pytest.fixture(name="fuzz")
def _fuzz(tmp_path, capfd):
    """Read damaged files: of each there is a result, or an error of one line that names it, and nothing on stderr."""

    def fuzz(read, make, name, errors=ValueError, cases=1000, megabytes=300, silent=True):
        """Give ``read`` the path of a file ``name`` whose bytes are ``make(rng)``; return how many were refused."""
        path, refused, before = folder / name, 0, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        capfd.readouterr()
        for seed in seeds(cases):
            path.unlink(missing_ok=True)
            path.write_bytes(make(random.Random(seed)))
            try:
                read(path)
            except errors as error:
                said = str(error)
                refused += 1
            except BaseException as error:
                error.add_note(f"seed {seed} of the damage")
                raise
            else:
                continue
            assert str(path) in said, f"seed {seed}: {said!r}"
            assert len(said.splitlines()) == 1, f"seed {seed}: {said!r}"
            assert len(said) < 1000, f"seed {seed}: {said}"
        assert not silent or capfd.readouterr().err == ""
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        assert grown < megabytes << 10, f"{grown >> 10} MiB for a file of {path.stat().st_size} bytes"
        assert refused, "nothing was damaged"
        return refused

    fuzz.damage, fuzz.values, fuzz.seeds = damage, damage_values, seeds
    # thousands of files: in memory where the system has such a place
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else tmp_path) as folder:
        folder = Path(folder)
        yield fuzz


@pytest.fixture(name="typed_in", scope="session")
def _typed_in():
    """A command in a process of its own, which has imported all that this one has; another would take seconds."""

    def run(folder, main, words):
        """Call ``main(words)`` in the folder; return the exit status."""
        import torch

        def typed():
            torch.set_num_threads(1)
            os.chdir(folder)
            raise SystemExit(main(words))

        process = multiprocessing.get_context("fork").Process(target=typed)
        process.start()
        process.join()
        return process.exitcode

    return run


@pytest.fixture(name="full_disk", scope="session")
def _full_disk():
    """No file grows beyond so many bytes; Python ignores the signal, so that writing fails as on a full disk."""

    @contextmanager
    def full(room):
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return full


@pytest.fixture(name="stays_whole")
def _stays_whole(full_disk, tmp_path):
    """A writer has no room, whatever there was before: one line names the file, and nothing has changed; later it has.

    Args of the fixture's function: the name of the file, and what writes it, given its path.
    """

    def check(name, write, rooms=(0, 2000), errors=(OSError, ValueError)):
        path = tmp_path / name
        for before in (None, b"old"):
            if before is not None:
                path.write_bytes(before)
            for room in rooms:
                with full_disk(room), pytest.raises(errors) as raised:
                    write(path)
                assert str(path) in str(raised.value), raised.value
                assert len(str(raised.value).splitlines()) == 1
                left = {other.name: other.read_bytes() for other in tmp_path.iterdir()}
                assert left == ({} if before is None else {name: before})
        write(path)
        assert path.stat().st_size > max(rooms)
        assert {other.name for other in tmp_path.iterdir()} == {name}

    return check

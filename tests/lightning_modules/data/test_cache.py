"""The cache of clips: what is not whole is never believed, whoever writes, is killed, or damages it."""

import os
import signal
import subprocess
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from inspect import getsource

import numpy as np
import pytest
import torch

from lightning_modules.data.cache import ClipCache, clip_key, pack_clip, unpack_clip

KEY = clip_key(frames=["a", "b"], scale=4)


def arrays(seed=0, size=1000):
    rng = np.random.default_rng(seed)
    return {"spikes": rng.integers(0, 256, (3, size), "uint8"), "flow": rng.normal(size=(2, size)).astype("float16")}


def same(one, other):
    return one is not None and one.keys() == other.keys() and all(np.array_equal(one[n], other[n]) for n in other)


def files(folder):
    return sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())


def test_a_clip_comes_back(tmp_path):
    cache = ClipCache(tmp_path / "new" / "folder")
    assert cache.load(KEY) is None
    cache.store(KEY, arrays())
    assert same(cache.load(KEY), arrays())
    assert same(ClipCache(tmp_path / "new" / "folder").load(KEY), arrays())
    assert cache.load(clip_key(frames=["b", "a"], scale=4)) is None
    assert [path.suffix for path in files(tmp_path)] == [".clip"]


@pytest.mark.parametrize("length", [0, 1, 31, 32, 33, 500, -1])
def test_a_part_of_a_clip_is_no_clip(tmp_path, length):
    cache = ClipCache(tmp_path)
    cache.store(KEY, arrays())
    (path,) = tmp_path.glob("*/*.clip")
    path.write_bytes(path.read_bytes()[:length])
    with pytest.warns(UserWarning, match="damaged"):
        assert cache.load(KEY) is None
    cache.store(KEY, arrays())
    assert same(cache.load(KEY), arrays())


def test_a_clip_under_the_name_of_another(tmp_path):
    cache, other = ClipCache(tmp_path), clip_key(scale=2)
    cache.store(KEY, arrays())
    cache._path(other).parent.mkdir(exist_ok=True)
    cache._path(KEY).rename(cache._path(other))
    with pytest.warns(UserWarning, match="damaged"):
        assert cache.load(other) is None


def _write(folder, rounds, size):
    cache = ClipCache(folder)
    for n in range(rounds):
        cache.store(clip_key(n=n % 3), arrays(seed=n % 3, size=size))


# Forks writers for every line that it reads. Pytest's own process has threads, and what is forked from it may hang.
WRITERS = f"""
import os, sys
import numpy as np
from lightning_modules.data.cache import ClipCache, clip_key

{getsource(arrays)}
{getsource(_write)}
for line in sys.stdin:
    rounds, count, folder = line.rstrip().split(" ", 2)
    writers = []
    for _ in range(int(count)):
        writers.append(os.fork())
        if not writers[-1]:
            _write(folder, int(rounds), 200_000)
            os._exit(0)
    print(*writers, flush=True)
    print(*(os.waitpid(writer, 0)[1] for writer in writers), flush=True)
"""


@pytest.fixture(scope="module")
def writers():
    """A process whose writers write to the cache."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", WRITERS], **pipes, start_new_session=True) as process:
        try:
            yield process
            process.stdin.close()
            process.wait(60)
        finally:  # a test that fails does not wait for a writer that would go on
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def begin(process, folder, rounds, count=1):
    """Let writers write so often, and return their numbers."""
    print(rounds, count, folder, file=process.stdin, flush=True)
    return [int(number) for number in process.stdout.readline().split()]


def _seen(folder):
    """The files in a folder; one that is written anew under the same name is another."""
    found = set()
    for path in folder.rglob("*"):
        with suppress(FileNotFoundError):
            stat = path.stat()
            found.add((path, stat.st_ino, stat.st_mtime_ns))
    return found


def _wait_for_a_new_file(folder, before):
    """However busy the machine is."""
    for _ in range(60_000):
        if _seen(folder) - before:
            return
        time.sleep(0.001)
    pytest.fail("nothing was written within a minute")


def test_killed_writers_leave_nothing_that_is_believed(writers, tmp_path):
    rng, unfinished = np.random.default_rng(0), 0
    expected = [arrays(seed=n, size=200_000) for n in range(3)]
    for _ in range(25):
        before = _seen(tmp_path)
        [writer] = begin(writers, tmp_path, 10**6)
        try:
            _wait_for_a_new_file(tmp_path, before)
            time.sleep(rng.choice([0, 0.001, 0.01, 0.05]))
        finally:
            os.kill(writer, signal.SIGKILL)
        assert writers.stdout.readline() == f"{int(signal.SIGKILL)}\n"
        unfinished = max(unfinished, len(list(tmp_path.rglob("*.part"))))
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # nothing has even to be recognised as damaged
            cache = ClipCache(tmp_path)
            for n in range(3):
                clip = cache.load(clip_key(n=n))
                assert clip is None or same(clip, expected[n])
    assert unfinished  # some were killed in the middle
    for part in tmp_path.rglob("*.part"):  # made again, which removes them
        number = next(n for n in range(10**6) if part.name.startswith(f".{cache._path(clip_key(n=n)).name}."))
        cache.store(clip_key(n=number), expected[0])
    assert not list(tmp_path.rglob("*.part"))


def test_two_writers_and_a_reader(writers, tmp_path):
    cache, expected = ClipCache(tmp_path), [arrays(seed=n, size=200_000) for n in range(3)]
    with ThreadPoolExecutor() as pool, warnings.catch_warnings():
        warnings.simplefilter("error")
        begin(writers, tmp_path, 20, count=2)
        ended = pool.submit(writers.stdout.readline)
        while not ended.done():
            for n in range(3):
                clip = cache.load(clip_key(n=n))
                assert clip is None or same(clip, expected[n])
        assert ended.result() == "0 0\n"
    assert all(same(cache.load(clip_key(n=n)), expected[n]) for n in range(3))
    assert len(files(tmp_path)) == 3


def test_a_clip_that_cannot_be_read(tmp_path):
    cache = ClipCache(tmp_path)
    cache._path(KEY).mkdir(parents=True)
    with pytest.warns(UserWarning, match="cannot be read"):
        assert cache.load(KEY) is None


# --- keys -------------------------------------------------------------------------------------------------------------


# --- packing ----------------------------------------------------------------------------------------------------------


def clip(levels, height=6, width=22, scale=2, flow=True):
    rng = np.random.default_rng(levels)
    values = np.sort(rng.random(levels, "float32"))
    rgb = values[rng.integers(0, levels, (3, scale * height, scale * width))]
    made = {
        "spikes": torch.from_numpy(rng.integers(0, 2, (41, height, width), "uint8")),
        "rgb": torch.from_numpy(rgb),
        "flow": torch.from_numpy(rng.normal(0, 5, (2, 2, height, width)).astype("float16").astype("float32")),
    }
    return made if flow else {name: made[name] for name in ("spikes", "rgb")}


@pytest.mark.parametrize(("levels", "dtype"), [(256, "uint8"), (257, "uint16")])
@pytest.mark.parametrize("flow", [True, False])
def test_packing_loses_nothing(levels, dtype, flow):
    original = clip(levels, 60, 70, flow=flow)
    packed = pack_clip(original)
    assert packed["rgb"].dtype == dtype
    assert packed["spikes"].nbytes == 41 * 60 * 9
    again = unpack_clip(packed, (0, 0, 60, 70), 2)
    assert again.keys() == original.keys()
    for name in again:
        assert again[name].dtype == original[name].dtype
        assert torch.equal(again[name], original[name]), name


def test_more_shades_than_sixteen_bits():
    original = {"spikes": torch.ones(2, 200, 200), "rgb": torch.rand(3, 200, 200, dtype=torch.float64).float()}
    packed = pack_clip(original)
    assert packed["rgb"].dtype == "float32"
    assert torch.equal(unpack_clip(packed, (2, 4, 100, 90), 1)["rgb"], original["rgb"][:, 2:102, 4:94])


@pytest.mark.parametrize(
    "part", [(0, 0, 6, 22), (2, 8, 4, 8), (1, 7, 3, 2), (0, 6, 6, 13), (5, 21, 1, 1), (2, 3, 2, 19)]
)
def test_a_part_is_cut_out(part):
    original, (top, left, height, width) = clip(200), part
    cut = unpack_clip(pack_clip(original), part, 2)
    rows, columns = slice(top, top + height), slice(left, left + width)
    assert torch.equal(cut["spikes"], original["spikes"][:, rows, columns])
    assert torch.equal(cut["flow"], original["flow"][:, :, rows, columns])
    rows, columns = slice(2 * top, 2 * (top + height)), slice(2 * left, 2 * (left + width))
    assert torch.equal(cut["rgb"], original["rgb"][:, rows, columns])

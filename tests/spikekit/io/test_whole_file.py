"""Writing whole files: after an error, a full disk and kills, side by side, and what is no ordinary file."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from spikekit.io import whole_file as module
from spikekit.io.whole_file import whole_file

MODULE = module.__file__
WRITER = """
import runpy, sys
module, path, letter = sys.argv[1:]
whole_file = runpy.run_path(module)["whole_file"]  # the rest of the package takes seconds
print("ready", flush=True)
while True:
    with whole_file(path) as file:
        for _ in range(50):
            file.write(letter.encode() * 4096)
"""
LIMIT = """
import resource, runpy, signal, sys
whole_file = runpy.run_path(sys.argv[1])["whole_file"]
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    with whole_file(sys.argv[2]) as file:
        file.write(b"x" * int(sys.argv[3]))
except OSError as error:
    print(error.strerror)
"""


def _half_of(file, error):
    file.write(b"half")
    raise error


def files(folder):
    return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def test_it_appears_when_it_is_complete(tmp_path):
    with whole_file(tmp_path / "deep" / "er" / "a.bin") as file:
        file.write(b"one")
        file.flush()
        assert not (tmp_path / "deep" / "er" / "a.bin").exists()
    assert files(tmp_path / "deep" / "er") == {"a.bin": b"one"}
    with whole_file(str(tmp_path / "deep" / "er" / "a.bin"), "w", encoding="utf-8", newline="") as file:
        file.write("é\r\n")
    assert files(tmp_path / "deep" / "er") == {"a.bin": "é\r\n".encode()}


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_an_error_leaves_what_was_there(tmp_path, error):
    (tmp_path / "a.bin").write_bytes(b"old")
    for name in ("a.bin", "b.bin"):
        with pytest.raises(error), whole_file(tmp_path / name) as file:
            _half_of(file, error)
    assert files(tmp_path) == {"a.bin": b"old"}


@pytest.mark.parametrize("name", ["fsync", "replace"])
def test_a_disk_that_fails_at_the_end(tmp_path, monkeypatch, name):
    def fail(*_):
        raise OSError(28, "No space left on device")

    (tmp_path / "a.bin").write_bytes(b"old")
    monkeypatch.setattr(os, name, fail)
    with pytest.raises(OSError, match="No space"), whole_file(tmp_path / "a.bin") as file:
        file.write(b"new")
    assert files(tmp_path) == {"a.bin": b"old"}


@pytest.mark.skipif(os.name != "posix", reason="limits of POSIX")
def test_a_full_disk(tmp_path):
    (tmp_path / "a.bin").write_bytes(b"old")
    for size in (1001, 10**6):  # at the flush and in the middle
        done = subprocess.run(
            [sys.executable, "-c", LIMIT, MODULE, tmp_path / "a.bin", str(size)],
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout == "File too large\n"
        assert files(tmp_path) == {"a.bin": b"old"}


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_two_writers_that_are_killed(tmp_path):
    """At random moments, seeded: the file is always one of theirs, whole, and their leftovers go."""
    target = tmp_path / "a.bin"
    chance = random.Random(24)
    whole = {letter.encode() * 4096 * 50 for letter in "ab"}
    for _ in range(6):
        writers = [
            subprocess.Popen([sys.executable, "-c", WRITER, MODULE, target, letter], stdout=subprocess.PIPE)
            for letter in "ab"
        ]
        for writer in writers:
            writer.stdout.readline()
        while not target.exists():
            time.sleep(0.001)
        for writer in writers:
            time.sleep(chance.uniform(0, 0.05))
            assert writer.poll() is None, "died of the other one"
            assert target.read_bytes() in whole
            writer.send_signal(signal.SIGKILL)
            writer.wait()
            writer.stdout.close()
        assert target.read_bytes() in whole
    with whole_file(target) as file:
        file.write(b"end")
    assert files(tmp_path) == {"a.bin": b"end"}


@pytest.mark.skipif(os.name != "posix", reason="locks of POSIX")
def test_leftovers_go_but_not_what_is_being_written(tmp_path):
    for n in (0, 3):
        (tmp_path / f".a[1].bin.{n}.part").write_bytes(b"left")
    (tmp_path / ".a1.bin.0.part").write_bytes(b"another's")
    with whole_file(tmp_path / "a[1].bin") as first:
        first.write(b"1")
        with whole_file(tmp_path / "a[1].bin") as second:
            second.write(b"2")
        assert files(tmp_path)["a[1].bin"] == b"2"
        assert sum(name.startswith(".a[1]") for name in files(tmp_path)) == 1
    assert files(tmp_path) == {"a[1].bin": b"1", ".a1.bin.0.part": b"another's"}


@pytest.mark.skipif(os.name != "posix", reason="modes and links of POSIX")
def test_modes_links_and_devices(tmp_path):
    (tmp_path / "any").touch()
    with whole_file(tmp_path / "new") as file:
        file.write(b"1")
    assert (tmp_path / "new").stat().st_mode == (tmp_path / "any").stat().st_mode
    (tmp_path / "new").chmod(0o600)
    with whole_file(tmp_path / "new") as file:
        file.write(b"2")
    assert (tmp_path / "new").stat().st_mode & 0o777 == 0o600
    (tmp_path / "link").symlink_to("new")
    with whole_file(tmp_path / "link") as file:
        file.write(b"3")
    assert not (tmp_path / "link").is_symlink()
    assert [(tmp_path / name).read_bytes() for name in ("new", "link")] == [b"2", b"3"]
    (tmp_path / "device").symlink_to("/dev/null")
    with whole_file(tmp_path / "device") as file:
        file.write(b"4")
    assert not (tmp_path / "device").is_symlink()
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    with whole_file(tmp_path / "pipe") as file:
        file.write(b"through")
    assert os.read(reader, 99) == b"through"
    os.close(reader)
    assert (tmp_path / "pipe").is_fifo()


def test_what_cannot_be_written(tmp_path):
    with pytest.raises(OSError), whole_file(tmp_path):  # noqa: PT011 - another one on another system
        pass
    (tmp_path / "file").touch()
    with pytest.raises(OSError), whole_file(tmp_path / "file" / "a"):  # noqa: PT011
        pass
    with pytest.raises(ValueError, match="expected 'w' or 'wb', got 'a'"), whole_file(tmp_path / "a", "a"):
        pass
    assert files(tmp_path) == {"file": b""}


def test_a_name_as_long_as_names_can_be(tmp_path):
    for name in ("a" * 255, "ä" * 127):
        with whole_file(tmp_path / name) as file:
            file.write(b"1")
    assert [len(os.fsencode(name)) for name in sorted(files(tmp_path))] == [255, 254]

"""Atomic writing: errors, full disks, killed and concurrent writers, links and devices."""

import errno
import multiprocessing
import os
import random
import time
from pathlib import Path

import pytest

from spikekit.io.whole_file import whole_file


def write_forever(path, letter):
    while True:
        with whole_file(path) as file:
            for _ in range(50):
                file.write(letter.encode() * 4096)


def files(folder):
    return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def test_file_appears_when_it_is_complete(tmp_path):
    with whole_file(tmp_path / "deep" / "er" / "a.bin") as file:
        file.write(b"one")
        file.flush()
        assert not (tmp_path / "deep" / "er" / "a.bin").exists()
    assert files(tmp_path / "deep" / "er") == {"a.bin": b"one"}
    with whole_file(str(tmp_path / "deep" / "er" / "a.bin"), "w", encoding="utf-8", newline="") as file:
        file.write("é\r\n")
    assert files(tmp_path / "deep" / "er") == {"a.bin": "é\r\n".encode()}


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit, "fsync", "replace"])
def test_error_or_full_disk_keeps_the_old_file(tmp_path, monkeypatch, error):
    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    (tmp_path / "a.bin").write_bytes(b"old")
    if isinstance(error, str):
        monkeypatch.setattr(os, error, fail)
    for name in ("a.bin", "b.bin"):
        raised = pytest.raises(OSError, match=name) if isinstance(error, str) else pytest.raises(error)
        with raised, whole_file(tmp_path / name) as file:
            file.write(b"half")
            if not isinstance(error, str):
                raise error
    assert files(tmp_path) == {"a.bin": b"old"}


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_two_killed_writers_leave_a_complete_file(tmp_path):
    """Killed at random times: the file is always complete, and leftovers are removed."""
    target = tmp_path / "a.bin"
    chance = random.Random(24)
    whole = {letter.encode() * 4096 * 50 for letter in "ab"}
    for _ in range(3):
        fork = multiprocessing.get_context("fork")  # another Python would take a second to import the package
        writers = [fork.Process(target=write_forever, args=(target, letter)) for letter in "ab"]
        for writer in writers:
            writer.start()
        while not target.exists():
            time.sleep(0.001)
        for writer in writers:
            time.sleep(chance.uniform(0, 0.05))
            assert writer.is_alive(), "died of the other one"
            assert target.read_bytes() in whole
            writer.kill()
            writer.join()
        assert target.read_bytes() in whole
    with whole_file(target) as file:
        file.write(b"end")
    assert files(tmp_path) == {"a.bin": b"end"}


@pytest.mark.skipif(os.name != "posix", reason="locks of POSIX")
def test_leftovers_are_removed_but_not_files_in_use(tmp_path):
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
def test_modes_links_and_pipes(tmp_path):
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
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="pipe"), whole_file(tmp_path / "pipe"):
        pass
    assert (tmp_path / "pipe").is_fifo()


def test_unwritable_paths_are_named(tmp_path):
    (tmp_path / "file").touch()
    for name in ("", "file/a"):
        with pytest.raises(OSError, match=str(tmp_path / name)), whole_file(tmp_path / name):
            pass
    assert files(tmp_path) == {"file": b""}


def test_the_longest_possible_name_is_written(tmp_path):
    for name in ("a" * 255, "ä" * 127):
        with whole_file(tmp_path / name) as file:
            file.write(b"1")
    assert [len(os.fsencode(name)) for name in sorted(files(tmp_path))] == [255, 254]

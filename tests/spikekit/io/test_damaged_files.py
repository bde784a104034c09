"""Damaged files of every kind: reading gives a result or a one-line error that names the file, and runs no code.

The environment variable SPIKEKIT_FUZZ=N sets the number of cases, SPIKEKIT_FUZZ_SEED=S their first seed.
"""

import io
import json
import os
import random
import tracemalloc
import zipfile

import numpy as np
import pytest
import tifffile
import torch
from deep_pictures import write_lzw_tiff
from PIL import Image

from spikekit import (
    Calibration,
    camera,
    iter_spikes,
    read_calibration,
    read_picture,
    read_spikes,
    read_video,
    write_calibration,
    write_picture,
    write_spikes,
    write_video,
)
from spikekit.io import PictureError, SpikeFileError, VideoError
from spikekit.io.sidecar import KIND, find_sidecar, read_sidecar

SPIKES = (torch.rand(6, 5, 9, generator=torch.Generator().manual_seed(0)) < 0.4).to(torch.uint8)

SIDECAR = {
    "kind": KIND,
    "stream": {"file": "walk.dat", "frames": 3, "height": 4, "width": 6, "sha256": "0" * 64},
    "truth": {"walk/0.png": 1.5},
    "source": {"path": "film", "frames": {"0.png": "0" * 64}},
    "settings": {
        "scale": 2, "pattern": "RGGB", "alpha": 0.4, "clocks": 20, "frame": None, "frames": 3, "seed": 0,
        "plan": "auto", "tolerance": 0.1, "step": 1.0, "interpolation": "Linear()", "noise": {"dark": 0.1},
    },
    "plan": {"frames": 3},
    "versions": {"spikekit": "0.1"},
}  # fmt: skip

CAMERA = {
    "title": "a camera", "height": 10, "width": 12, "drop": [[3, 5]], "rate": 20000, "flip": True, "pattern": "BGGR",
    "crop": [1, 1, 0, 2], "gain": 1.5, "gamma": 2.2, "source": "a page",
}  # fmt: skip


def read_all(path):
    """Read a file like the commands; the size of a .dat is given."""
    size = (5, 9) if path.suffix == ".dat" else ()
    for packed in (False, True):
        for _ in iter_spikes(path, *size, flip=True, chunk=4, packed=packed):
            pass
    read_spikes(path, *size, start=0, frames=1)


def frames_of(path):
    frames = read_video(path)
    for n in range(min(len(frames), 6)):
        assert frames[n].shape == (3, frames.height, frames.width)


def saved(write):
    def make(path):
        write(path)
        return path.read_bytes()

    return make


def picture(kind, mode="RGB", **how):
    pixels = np.random.default_rng(0).integers(0, 256, (12, 14, 3), "uint8")
    pixels[3:7] = 90
    return saved(lambda path: Image.fromarray(pixels).convert(mode).save(path, kind, **how))


def tiff(**how):
    pixels = np.arange(12 * 14 * 3).reshape(12, 14, 3).astype("uint16")
    return saved(lambda path: tifffile.imwrite(path, pixels, **how))


def film(path):
    pytest.importorskip("av")
    write_video(path, [torch.full((3, 32, 48), n / 12) for n in range(5)])
    return path.read_bytes()


PICTURES = {
    "a.png": picture("PNG"),
    "palette.png": picture("PNG", "P"),
    "alpha.png": picture("PNG", "LA"),
    "deep.png": saved(lambda path: write_picture(path, torch.rand(3, 12, 14), bits=16)),
    "a.jpg": picture("JPEG"),
    "cmyk.jpg": picture("JPEG", "CMYK"),
    "a.webp": picture("WEBP"),
    "a.gif": picture("GIF"),
    "a.bmp": picture("BMP"),
    "a.ppm": picture("PPM"),
    "a.tif": picture("TIFF", compression="tiff_adobe_deflate"),
    "deep.tiff": tiff(photometric="rgb"),
    "tiles.tif": tiff(photometric="rgb", tile=(16, 16)),
    "planes.tif": tiff(photometric="minisblack", compression="zlib"),
    "lzw.tif": saved(lambda path: write_lzw_tiff(path, np.arange(504, dtype="uint16").reshape(12, 14, 3))),
}

FILES = {  # what is damaged: how it is read, what makes a good one, the error, how many are damaged
    "a.dat": (read_all, saved(lambda path: write_spikes(path, SPIKES)), SpikeFileError, 700),
    "a.npz": (read_all, saved(lambda path: np.savez(path, spk=SPIKES.numpy())), SpikeFileError, 500),
    "packed.npz": (
        read_all,
        saved(lambda path: np.savez_compressed(path, spikes=SPIKES.numpy().astype(float), alpha=0.4)),
        SpikeFileError,
        500,
    ),
    "fortran.npy": (
        read_all,
        saved(lambda path: np.save(path, np.asfortranarray(SPIKES.numpy().astype(bool)))),
        SpikeFileError,
        300,
    ),
    "a.safetensors": (
        read_calibration,
        saved(lambda path: write_calibration(path, Calibration(*torch.ones(2, 4, 6), torch.zeros(4, 6).byte()))),
        ValueError,
        700,
    ),
    **{name: (read_picture, good, PictureError, 250) for name, good in PICTURES.items()},
    "a.mp4": (frames_of, film, VideoError, 100),
    "a.mkv": (frames_of, film, VideoError, 100),
}


@pytest.mark.parametrize("name", FILES)
def test_damaged_bytes_give_one_line(fuzz, name, tmp_path, monkeypatch):
    read, make, error, cases = FILES[name]
    good = make(tmp_path / name)
    for module in ("images", "video"):  # so that this is what bounds the memory
        monkeypatch.setattr(f"spikekit.io.{module}.MOST_PIXELS", 1 << 20)
    silent = ".tif" not in name  # libtiff prints
    fuzz(read, lambda rng: fuzz.damage(good, rng), f"bad_{name}", error, cases, silent=silent)


@pytest.mark.parametrize(
    ("read", "good"),
    [(read_sidecar, SIDECAR), (lambda path: find_sidecar(path.with_suffix(".dat")), SIDECAR), (camera, CAMERA)],
    ids=["read_sidecar", "find_sidecar", "camera"],
)
def test_damaged_json_gives_one_line(fuzz, read, good):
    text = json.dumps(good, indent=1).encode()
    fuzz(read, lambda rng: fuzz.damage(text, rng), "walk.json", cases=500)
    fuzz(read, lambda rng: json.dumps(fuzz.values(good, rng)).encode(), "walk.json")


def test_damaged_headers_of_npz_give_one_line(fuzz):
    """The archive is valid but its array is not."""

    def make(rng):
        header = io.BytesIO()
        shape = tuple(rng.choice((-1, 0, 1, 5, 6, 9, 2**20, 2**31, 2**62, 10**30)) for _ in range(rng.randrange(5)))
        descr = rng.choice(("|u1", "<f8", "|b1", "|O", "<U9", ">i2", "|V0", "<M8[s]", "<c16", "|u9", "", None, [], 5))
        text = repr({"descr": descr, "fortran_order": rng.choice((True, False, 3)), "shape": shape})
        text = text if rng.random() < 0.8 else fuzz.damage(text.encode(), rng).decode("latin-1")
        header.write(b"\x93NUMPY" + bytes((rng.choice((1, 2, 3, 9)), 0)))
        header.write(len(text.encode("latin-1")).to_bytes(rng.choice((2, 2, 4)), "little"))
        header.write(text.encode("latin-1") + bytes(rng.choice((0, 1, 270, 2160))))
        with zipfile.ZipFile(file := io.BytesIO(), "w", rng.choice((0, 8))) as archive:
            archive.writestr("spk.npy", header.getvalue())
        return file.getvalue()

    assert fuzz(read_all, make, "bad.npz", SpikeFileError) > 500


def test_a_header_of_gigabytes_is_not_read(tmp_path):
    with open(tmp_path / "a.npy", "wb") as file:
        file.write(b"\x93NUMPY\x02\x00" + (2**30).to_bytes(4, "little"))
        file.truncate(2**30 + 12)
    tracemalloc.start()
    with pytest.raises(SpikeFileError, match="header"):
        read_all(tmp_path / "a.npy")
    assert tracemalloc.get_traced_memory()[1] < 2**22
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("read", "name"),
    [
        (read_sidecar, "a.json"),
        (camera, "a.json"),
        (read_calibration, "a.safetensors"),
        (read_picture, "a.png"),
        (read_video, "a.mp4"),
        (read_spikes, "a.npz"),
        (lambda path: read_spikes(path, 4, 4), "a.dat"),
    ],
)
def test_pipes_are_rejected(read, name, tmp_path):
    os.mkfifo(tmp_path / name)
    with pytest.raises((ValueError, FileNotFoundError), match=f"{name}: ") as refused:
        read(tmp_path / name)
    assert len(str(refused.value).splitlines()) == 1
    assert find_sidecar(tmp_path / "a.npz") is None


def test_a_film_or_a_picture_opens_no_other_file(tmp_path):
    """FFmpeg would read a playlist under any name."""
    other = film(tmp_path / "other.mp4")
    concat = b"ffconcat version 1.0\nfile other.mp4\n"
    for name, data in (("a.mp4", concat), ("a.png", concat), ("b.png", other)):
        (tmp_path / name).write_bytes(data)
        with pytest.raises((VideoError, PictureError), match=f"{name}: "):
            (read_video if name == "a.mp4" else read_picture)(tmp_path / name)


def test_damaged_pictures_of_a_folder_are_named(fuzz, tmp_path):
    """Circular links, pipes, folders and invalid files among the pictures of a film."""
    good = [PICTURES["a.png"](tmp_path / "a.png"), PICTURES["a.jpg"](tmp_path / "a.jpg")]
    good += [good[0][:60], b"", b"\x89PNG"]
    refused = 0
    for seed in (cases := fuzz.seeds(60)):
        rng, folder = random.Random(seed), tmp_path / f"{seed}"
        folder.mkdir()
        for k in range(rng.randrange(4)):
            path = folder / f"{rng.choice(('f', '٣', '9' * 30, ''))}{k}{rng.choice(('.png', '.jpg', '.PNG', '.txt'))}"
            kind = rng.choice(("file", "file", "file", "folder", "loop", "nowhere", "pipe"))
            if kind == "file":
                path.write_bytes(rng.choice(good))
            elif kind == "folder":
                path.mkdir()
            elif kind == "pipe":
                os.mkfifo(path)
            else:
                path.symlink_to(path if kind == "loop" else folder / "nowhere")
        try:
            list(read_video(folder))
        except VideoError as error:
            refused += 1
            said = str(error)
        else:
            continue
        assert str(folder) in said
        assert len(said.splitlines()) == 1
    assert 0.3 < refused / len(cases) < 1


@pytest.mark.parametrize("name", ["a.png", "a.bmp", "a.tif", "deep.tiff", "a.dat", "a.npz"])
def test_small_files_that_claim_huge_pictures_are_rejected(name, tmp_path, monkeypatch):
    """Headers are checked before memory is allocated; 260 kB could unpack to gigabytes."""
    read, make, error, _ = FILES[name]
    make(tmp_path / name)
    module, least, most = ("files", 45, 44) if read is read_all else ("images", 1000, 20)
    monkeypatch.setattr(f"spikekit.io.{module}.MOST_PIXELS", least)
    read(tmp_path / name)
    monkeypatch.setattr(f"spikekit.io.{module}.MOST_PIXELS", most)
    with pytest.raises(error, match=f"{name}: .*at most {most} pixels, got"):
        read(tmp_path / name)

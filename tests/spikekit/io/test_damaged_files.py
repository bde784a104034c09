"""Damaged files of every kind that spikekit reads.

SPIKEKIT_FUZZ=N in the environment gives each N cases, and SPIKEKIT_FUZZ_SEED=S others: those of the seeds from S.
"""

import io
import json
import os
import random
import zipfile

import numpy as np
import pytest
import torch
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
    write_spikes,
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
        "scale": 2, "pattern": "RGGB", "alpha": 0.4, "clocks": 20, "frame": None, "frames": 3, "readout": 1, "seed": 0,
        "plan": "auto", "tolerance": 0.1, "step": 1.0, "interpolation": "Linear()", "noise": {"dark": 0.1},
    },
    "plan": {"frames": 3},
    "versions": {"spikekit": "0.1"},
}  # fmt: skip

CAMERA = {
    "title": "a camera", "height": 10, "width": 12, "drop": [[3, 5]], "rate": 20000, "flip": True, "pattern": "BGGR",
    "crop": [1, 1, 0, 2], "gain": 1.5, "gamma": 2.2, "source": "a page",
}  # fmt: skip


def _read_all(path):
    for packed in (False, True):
        for _ in iter_spikes(path, 5, 9, flip=True, chunk=4, packed=packed):
            pass
    read_spikes(path, 5, 9, start=1, frames=2)


def test_dat(fuzz, tmp_path):
    write_spikes(good := tmp_path / "good.dat", SPIKES)
    assert fuzz(_read_all, lambda rng: fuzz.damage(good.read_bytes(), rng), "bad.dat", SpikeFileError) > 200


@pytest.mark.parametrize(
    "save",
    [
        lambda file: np.savez(file, spk=SPIKES.numpy()),
        lambda file: np.savez_compressed(file, spikes=SPIKES.numpy().astype(float), alpha=0.4),
        lambda file: np.savez(file, a=np.asfortranarray(SPIKES.numpy().astype(bool))),
    ],
)
def test_npz(fuzz, save):
    save(file := io.BytesIO())
    good = file.getvalue()

    def read(path):
        for _ in iter_spikes(path, chunk=4, packed=True):
            pass
        read_spikes(path, start=0, frames=1)

    assert fuzz(read, lambda rng: fuzz.damage(good, rng), "bad.npz", SpikeFileError, 700) > 200


def test_headers_of_npz(fuzz):
    """Where the archive is whole, and what it holds is not."""

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

    assert fuzz(_read_all, make, "bad.npz", SpikeFileError) > 500


def test_calibrations(fuzz, tmp_path):
    planes = torch.ones(4, 6), torch.zeros(4, 6), torch.zeros(4, 6, dtype=torch.uint8)
    write_calibration(good := tmp_path / "good.safetensors", Calibration(*planes))
    assert fuzz(read_calibration, lambda rng: fuzz.damage(good.read_bytes(), rng), "bad.safetensors") > 300


def _json(value):
    return json.dumps(value, indent=1).encode()


@pytest.mark.parametrize(
    ("read", "good"),
    [(read_sidecar, SIDECAR), (lambda path: find_sidecar(path.with_suffix(".dat")), SIDECAR), (camera, CAMERA)],
    ids=["read_sidecar", "find_sidecar", "camera"],
)
def test_json(fuzz, read, good):
    fuzz(read, lambda rng: fuzz.damage(_json(good), rng), "walk.json")
    fuzz(read, lambda rng: _json(fuzz.values(good, rng)), "walk.json")


def _picture(kind, mode="RGB", **how):
    pixels = np.random.default_rng(0).integers(0, 256, (12, 14, 3), "uint8")
    pixels[3:7] = 90
    Image.fromarray(pixels).convert(mode).save(file := io.BytesIO(), kind, **how)
    return file.getvalue()


def _tiff(**how):
    import tifffile

    tifffile.imwrite(file := io.BytesIO(), np.arange(12 * 14 * 3).reshape(12, 14, 3).astype("uint16"), **how)
    return file.getvalue()


_PICTURES = {
    "png": lambda: _picture("PNG"),
    "palette.png": lambda: _picture("PNG", "P"),
    "alpha.png": lambda: _picture("PNG", "LA"),
    "jpg": lambda: _picture("JPEG"),
    "cmyk.jpg": lambda: _picture("JPEG", "CMYK"),
    "webp": lambda: _picture("WEBP"),
    "gif": lambda: _picture("GIF"),
    "bmp": lambda: _picture("BMP"),
    "ppm": lambda: _picture("PPM"),
    "tif": lambda: _picture("TIFF", compression="tiff_adobe_deflate"),
    "tiff": lambda: _tiff(photometric="rgb"),
    "tiles.tif": lambda: _tiff(photometric="rgb", tile=(16, 16)),
    "planes.tif": lambda: _tiff(photometric="minisblack", compression="zlib"),
}


@pytest.mark.parametrize("kind", _PICTURES)
def test_pictures(fuzz, kind, monkeypatch):
    good = _PICTURES[kind]()
    monkeypatch.setattr("spikekit.io.images.MOST_PIXELS", 1 << 20)  # so that it is what bounds the memory
    fuzz(
        read_picture, lambda rng: fuzz.damage(good, rng), f"bad.{kind}", PictureError, 400, silent="tif" not in kind
    )  # libtiff prints


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
def test_a_pipe_is_not_waited_for(read, name, tmp_path):
    os.mkfifo(tmp_path / name)
    with pytest.raises((ValueError, FileNotFoundError), match=f"{name}: ") as refused:
        read(tmp_path / name)
    assert len(str(refused.value).splitlines()) == 1


def test_a_pipe_beside_a_recording_is_no_sidecar(tmp_path):
    write_spikes(tmp_path / "a.npz", SPIKES)
    os.mkfifo(tmp_path / "a.json")
    assert find_sidecar(tmp_path / "a.npz") is None


def _film(path, codec):
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width, stream.pix_fmt = 32, 48, "yuv420p"
        for n in range(5):
            grey = np.full((32, 48, 3), 20 * n, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(grey, format="rgb24")))
        container.mux(stream.encode(None))
    return path.read_bytes()


@pytest.mark.parametrize(("name", "codec"), [("bad.mp4", "libx264"), ("bad.mkv", "ffv1"), ("bad.avi", "mpeg4")])
def test_videos(fuzz, name, codec, tmp_path, monkeypatch):
    good = _film(tmp_path / name, codec)
    monkeypatch.setattr("spikekit.io.video.MOST_PIXELS", 1 << 20)

    def read(path):
        frames = read_video(path)
        for n in range(min(len(frames), 6)):
            assert frames[n].shape == (3, frames.height, frames.width)

    fuzz(read, lambda rng: fuzz.damage(good, rng), name, VideoError, 150)


def test_a_video_opens_no_other_file(tmp_path):
    _film(tmp_path / "other.mp4", "libx264")
    assert len(read_video(tmp_path / "other.mp4")) == 5
    (tmp_path / "list.mp4").write_text("ffconcat version 1.0\nfile other.mp4\n")
    with pytest.raises(VideoError, match=r"list.mp4: .*"):
        read_video(tmp_path / "list.mp4")


def test_a_picture_opens_no_other_file(tmp_path):
    """Where a library is asked that tries everything, FFmpeg takes a list of pictures for a film."""
    _film(tmp_path / "other.mp4", "libx264")
    for name, text in {"a.png": "ffconcat version 1.0\nfile other.mp4\n", "b.png": (tmp_path / "other.mp4")}.items():
        (tmp_path / name).write_bytes(text.encode() if isinstance(text, str) else text.read_bytes())
        with pytest.raises(PictureError, match=f"{name}: not a picture"):
            read_picture(tmp_path / name)


def test_folders_of_pictures(fuzz, tmp_path):
    """Links to itself, pipes, folders and nonsense among the pictures of a film."""
    good = [_picture("PNG"), _picture("JPEG"), _picture("PNG")[:60], b"", b"\x89PNG"]
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
            said = str(error)
            refused += 1
        else:
            continue
        assert str(folder) in said
        assert len(said.splitlines()) == 1
    assert 0.3 < refused / len(cases) < 1


@pytest.mark.parametrize("kind", ["png", "bmp", "tif", "tiff"])
def test_a_few_bytes_that_claim_a_large_picture(kind, tmp_path, monkeypatch):
    """What is refused by its header takes no memory."""
    (tmp_path / f"a.{kind}").write_bytes(_PICTURES[kind]())
    assert read_picture(tmp_path / f"a.{kind}").shape == (3, 12, 14)
    monkeypatch.setattr("spikekit.io.images.MOST_PIXELS", 20)
    with pytest.raises(PictureError, match=f"a.{kind}: not a picture .*expected at most 20 pixels, got"):
        read_picture(tmp_path / f"a.{kind}")


@pytest.mark.parametrize("ending", [".dat", ".npz"])
def test_frames_of_a_recording_are_no_larger_than_pictures(ending, tmp_path, monkeypatch):
    """A packed file of 260 kB could hold a frame whose statistics take gigabytes."""
    write_spikes(path := tmp_path / f"a{ending}", SPIKES)
    monkeypatch.setattr("spikekit.io.files.MOST_PIXELS", 45)
    assert read_spikes(path, 5, 9).equal(SPIKES)
    monkeypatch.setattr("spikekit.io.files.MOST_PIXELS", 44)
    with pytest.raises(SpikeFileError, match=f"a{ending}: expected frames of at most 44 pixels, got 5 x 9"):
        read_spikes(path, 5, 9)


@pytest.mark.parametrize("shape", [(1, 1 << 20, 1 << 20), (6, 5, 10), (6, 5, 8)])
def test_an_npz_that_declares_another_size_than_it_holds(shape, tmp_path):
    np.lib.format.write_array_header_1_0(
        header := io.BytesIO(), {"descr": "|u1", "fortran_order": False, "shape": shape}
    )
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("spk.npy", header.getvalue() + SPIKES.numpy().tobytes())
    assert (tmp_path / "a.npz").stat().st_size < 700
    with pytest.raises(SpikeFileError, match=r"a.npz: truncated, spk of .* takes \d+ bytes, the file holds 270"):
        read_spikes(tmp_path / "a.npz")

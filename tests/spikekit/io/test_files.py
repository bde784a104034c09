"""Recordings: bits, rows, flips, parts of files, and every way in which a file can be wrong."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch

from spikekit import SpikeFileError, iter_spikes, read_spikes, spikes_shape, write_spikes
from spikekit.decoders.packing import pack_spikes

SPIKES = Path(__file__).parents[3].parent / "shared" / "data" / "spikes"
REDS = SPIKES / "reds_sim_mono_203_250x400.dat"
UHSR = SPIKES / "uhsr_real_mono_helicopter_250x250.npz"
needs_data = pytest.mark.skipif(not SPIKES.is_dir(), reason="the shared recordings are not beside the repository")


def random_spikes(*shape):
    return (torch.rand(shape) < 0.4).to(torch.uint8)


@pytest.fixture
def clip(tmp_path):
    """A recording of 5 frames of 3 x 5, 2 bytes each."""
    write_spikes(tmp_path / "clip.dat", random_spikes(5, 3, 5))
    return tmp_path / "clip.dat"


# --- bits, rows, flips ------------------------------------------------------------------------------------------------


def test_bits_by_hand(tmp_path):
    """Two frames of 2 x 8: the leftmost pixel is the least significant bit, rows follow each other."""
    (tmp_path / "a.dat").write_bytes(bytes([0b00000001, 0b11000000, 0b00010010, 0b11111111]))
    expected = [
        [[1, 0, 0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0, 1, 1]],
        [[0, 1, 0, 0, 1, 0, 0, 0], [1, 1, 1, 1, 1, 1, 1, 1]],
    ]
    spikes = read_spikes(tmp_path / "a.dat", 2, 8)
    assert spikes.dtype is torch.uint8
    assert spikes.tolist() == expected
    assert read_spikes(tmp_path / "a.dat", 2, 8, flip=True).tolist() == [frame[::-1] for frame in expected]


def test_padding_by_hand(tmp_path):
    """A frame of 3 x 3 takes two bytes; rows run on across them, and the seven bits that are left say nothing."""
    (tmp_path / "a.dat").write_bytes(bytes([0b10100001, 0b11111110, 0, 0b00000001]))
    assert read_spikes(tmp_path / "a.dat", 3, 3).tolist() == [
        [[1, 0, 0], [0, 0, 1], [0, 1, 0]],
        [[0, 0, 0], [0, 0, 0], [0, 0, 1]],
    ]


def test_written_by_hand(tmp_path):
    spikes = torch.tensor([[[1, 0, 0], [0, 0, 1], [0, 1, 1]]])
    write_spikes(tmp_path / "a.dat", spikes)
    assert (tmp_path / "a.dat").read_bytes() == bytes([0b10100001, 0b00000001])
    write_spikes(tmp_path / "a.dat", spikes, flip=True)
    assert (tmp_path / "a.dat").read_bytes() == bytes([0b01100110, 0b00000000])
    write_spikes(tmp_path / "a.npz", spikes)
    with np.load(tmp_path / "a.npz") as arrays:
        assert list(arrays) == ["spk"]
        assert arrays["spk"].dtype == np.uint8
        assert arrays["spk"].tolist() == spikes.tolist()


@pytest.mark.parametrize("suffix", [".dat", ".npz", ".DAT", ".NPZ"])
@pytest.mark.parametrize("shape", [(1, 1, 1), (4, 3, 5), (2, 7, 9), (6, 16, 24)])
def test_round_trip(tmp_path, shape, suffix):
    spikes = random_spikes(*shape)
    path = tmp_path / "made" / f"clip{suffix}"
    for flip in (False, True):
        write_spikes(path, spikes, flip=flip)
        assert read_spikes(path, *shape[1:], flip=flip).equal(spikes)
        assert read_spikes(path, *shape[1:], flip=not flip).equal(spikes.flip(-2))
        assert spikes_shape(path, *shape[1:]) == shape
    assert [file.name for file in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize(
    "dtype", [torch.bool, torch.uint8, torch.int64, torch.float16, torch.bfloat16, torch.float32, torch.float64]
)
def test_written_dtypes(tmp_path, dtype):
    spikes = random_spikes(3, 4, 5)
    for name in ("a.dat", "a.npz"):
        write_spikes(tmp_path / name, spikes.to(dtype))
        assert read_spikes(tmp_path / name, 4, 5).equal(spikes)


def test_written_views_and_gradients(tmp_path):
    spikes = random_spikes(5, 4, 3).permute(2, 0, 1).float().requires_grad_()
    write_spikes(tmp_path / "a.dat", spikes)
    assert read_spikes(str(tmp_path / "a.dat"), 5, 4).equal(spikes.detach().byte())


# --- parts of recordings ----------------------------------------------------------------------------------------------


def test_reads_only_what_is_asked_for(tmp_path):
    """Of a recording of 10 GB, two frames take the memory of two frames."""
    path = tmp_path / "long.dat"
    with open(path, "wb") as file:
        file.truncate(800_000 * 12_500)
        file.seek(700_000 * 12_500)
        file.write(b"\x01")
    tracemalloc.start()
    spikes = read_spikes(path, 250, 400, start=699_999, frames=2)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert spikes.nonzero().tolist() == [[1, 0, 0]]
    assert spikes_shape(path, 250, 400) == (800_000, 250, 400)
    assert peak < 8 * 100_000


@pytest.mark.parametrize("name", ["a.dat", "a.npy", "a.npz"])
@pytest.mark.parametrize("width", [5, 16])
@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("packed", [False, True])
def test_chunks_equal_the_whole(tmp_path, name, width, flip, packed):
    spikes = random_spikes(11, 3, width)
    write_spikes(tmp_path / name, spikes, flip=flip)
    options = {"flip": flip, "packed": packed}
    whole = pack_spikes(spikes) if packed else spikes
    assert read_spikes(tmp_path / name, 3, width, **options).equal(whole)
    assert read_spikes(tmp_path / name, 3, width, **options, start=4, frames=3).equal(whole[4:7])
    assert torch.stack(list(iter_spikes(tmp_path / name, 3, width, **options))).equal(whole)
    for chunk in (1, 4, 11, 100, np.int64(3)):
        chunks = list(iter_spikes(tmp_path / name, 3, width, **options, chunk=chunk))
        assert torch.cat(chunks).equal(whole)
        assert [len(part) for part in chunks[:-1]] == [chunk] * (len(chunks) - 1)
        chunks = list(iter_spikes(tmp_path / name, 3, width, **options, chunk=chunk, start=2, frames=7))
        assert torch.cat(chunks).equal(whole[2:9])
    for tensor in (read_spikes(tmp_path / name, 3, width, **options), chunks[0]):
        assert tensor.is_contiguous()
        tensor.zero_()  # its own memory, and writable


@pytest.mark.parametrize("name", ["a.dat", "a.npy", "a.npz"])
@pytest.mark.parametrize("cuts", [[1] * 11, [4, 4, 3]])
@pytest.mark.parametrize("flip", [False, True])
def test_written_in_chunks(tmp_path, name, cuts, flip):
    """The same bytes as written at once, in chunks of several types, or frame by frame."""
    spikes = random_spikes(11, 3, 5)
    write_spikes(tmp_path / "whole" / name, spikes, flip=flip)
    dtypes = [torch.bool, torch.float32, torch.uint8, torch.bfloat16] * 3
    chunks = (part.to(dtype) for part, dtype in zip(spikes.split(cuts), dtypes, strict=False))
    write_spikes(tmp_path / "chunks" / name, chunks, flip=flip)
    write_spikes(tmp_path / "frames" / name, list(spikes), flip=flip)
    for folder in ("whole", "chunks", "frames"):
        assert read_spikes(tmp_path / folder / name, 3, 5, flip=flip).equal(spikes)
        assert [file.name for file in (tmp_path / folder).iterdir()] == [name]
    if name == "a.dat":
        assert len({(tmp_path / folder / name).read_bytes() for folder in ("whole", "chunks", "frames")}) == 1


@pytest.mark.parametrize("name", ["a.dat", "a.npy", "a.npz"])
def test_chunks_in_bounded_memory(tmp_path, name):
    """8 MB go through in chunks of 400 kB, written and read."""
    tracemalloc.start()
    write_spikes(tmp_path / name, (torch.ones(10, 100, 400, dtype=torch.uint8) for _ in range(20)))
    count = sum(int(part[:, 0, 0].sum()) for part in iter_spikes(tmp_path / name, 100, 400, chunk=10))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == 200
    assert peak < 1_600_000


# --- arrays of .npz ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["spk", "spikes", "anything"])
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_array_names(tmp_path, name, save):
    spikes = random_spikes(4, 3, 5)
    others = {"label": np.int64(3), "title": np.array("street"), "picture": np.zeros((3, 5))}
    save(tmp_path / "a.npz", **others, **{name: spikes.numpy()})
    assert spikes_shape(tmp_path / "a.npz") == (4, 3, 5)
    assert read_spikes(tmp_path / "a.npz", height=3).equal(spikes)


def test_named_array_comes_first(tmp_path):
    spikes = random_spikes(4, 3, 5)
    np.savez(tmp_path / "a.npz", flow=np.zeros((2, 3, 5)), spikes=spikes.numpy())
    assert read_spikes(tmp_path / "a.npz").equal(spikes)


@pytest.mark.parametrize("dtype", ["bool", "int8", ">i2", "<u4", "float16", ">f4", "float64"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_array_dtypes_and_orders(tmp_path, dtype, order):
    spikes = random_spikes(4, 3, 5)
    np.savez(tmp_path / "a.npz", spk=np.asarray(spikes.numpy(), dtype=dtype, order=order))
    assert read_spikes(tmp_path / "a.npz").equal(spikes)
    assert read_spikes(tmp_path / "a.npz", start=1, frames=2, flip=True).equal(spikes[1:3].flip(-2))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"label": np.int64(3)}, r"expected one array \(T, H, W\).*spk or spikes.*got label \(\)"),
        ({"a": np.zeros((2, 3, 4)), "b": np.zeros((5, 3, 4))}, r"a \(2, 3, 4\), b \(5, 3, 4\)"),
        ({"spk": np.zeros((0, 3, 4))}, r"empty recording, spk is \(0, 3, 4\)"),
        ({"spk": np.zeros((1, 3, 4), complex)}, r"spk .* of type complex128"),
        ({"spk": np.full((1, 1, 1), None)}, r"spk .* of type object"),
        ({"spk": np.array([[[0, 1]], [[0, 3]]])}, "zeros and ones, got values from 0 to 3 in frame 1"),
        ({"spk": np.full((1, 2, 2), np.nan)}, "got values from nan to nan in frame 0"),
    ],
)
def test_wrong_arrays(tmp_path, arrays, message):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(SpikeFileError, match=f"a.npz: .*{message}") as caught:
        read_spikes(tmp_path / "a.npz")
    assert "\n" not in str(caught.value)


# --- files that cannot be used ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("read", [read_spikes, iter_spikes, spikes_shape])
def test_wrong_files(tmp_path, read):
    (tmp_path / "empty.dat").touch()
    (tmp_path / "empty.npz").touch()
    (tmp_path / "clip.raw").write_bytes(bytes(8))
    (tmp_path / "clip").write_bytes(bytes(8))
    (tmp_path / "folder.dat").mkdir()
    for name, message in [
        ("none.dat", "no such file"),
        ("none.npz", "no such file"),
        ("folder.dat", "got a folder"),
        ("empty.dat", "an empty file, 0 bytes"),
        ("empty.npz", "an empty file, 0 bytes"),
        ("clip.raw", "ends in .dat, .npy, .npz, got .raw"),
        ("clip", "ends in .dat, .npy, .npz, got no ending"),
    ]:
        with pytest.raises(SpikeFileError, match=f"{tmp_path / name}: .*{message}"):
            read(tmp_path / name, 3, 5)


@pytest.mark.parametrize("read", [read_spikes, iter_spikes, spikes_shape])
@pytest.mark.parametrize(
    ("size", "message"),
    [
        ((None, None), "no header, expected height and width, got None and None"),
        ((0, 5), "at least 1, got 0 and 5"),
        ((5, 5), "truncated, or not 5 x 5: 10 bytes at 4 bytes a frame make 2 whole frames and 2 bytes left over"),
    ],
)
def test_wrong_sizes(clip, read, size, message):
    with pytest.raises(SpikeFileError, match=f"clip.dat: .*{message}"):
        read(clip, *size)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda clip: read_spikes(clip, 3.0, 5), TypeError, r"height: expected a whole number, got 3\.0"),
        (lambda clip: read_spikes(clip, 3, 5, start=1.0), TypeError, r"start: expected a whole number, got 1\.0"),
        (lambda clip: iter_spikes(clip, 3, 5, frames=1.5), TypeError, r"frames: expected a whole number, got 1\.5"),
        (lambda clip: iter_spikes(clip, 3, 5, chunk=0), ValueError, "chunk: expected a whole number >= 1, got 0"),
    ],
)
def test_numbers_that_are_not_whole(clip, call, error, message):
    with pytest.raises(error, match=message):
        call(clip)


def test_numpy_numbers(clip):
    whole = read_spikes(clip, 3, 5)
    assert read_spikes(clip, np.int32(3), np.uint8(5), start=np.int64(1), frames=torch.tensor(2)).equal(whole[1:3])


def test_truncated_while_it_is_read(clip):
    frames = iter_spikes(clip, 3, 5)
    clip.write_bytes(b"")
    with pytest.raises(SpikeFileError, match=r"clip\.dat: truncated while it was read, at frame 0"):
        next(frames)


@pytest.mark.parametrize("size", [(3, 6), (4, None)])
def test_npz_of_another_size(tmp_path, size):
    write_spikes(tmp_path / "a.npz", random_spikes(2, 3, 5))
    with pytest.raises(SpikeFileError, match=f"a.npz: holds frames of 3 x 5, got height {size[0]} and width {size[1]}"):
        read_spikes(tmp_path / "a.npz", *size)


@pytest.mark.parametrize("read", [read_spikes, iter_spikes])
@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"start": -1}, "6 from frame -1 on"),
        ({"start": 3, "frames": 3}, "3 from frame 3 on"),
        ({"frames": 6}, "6 from frame 0 on"),
    ],
)
def test_frames_that_are_not_there(clip, read, part, message):
    with pytest.raises(SpikeFileError, match=rf"clip.dat: expected frames within 0 \.\. 4, got {message}"):
        read(clip, 3, 5, **part)


# --- writing that fails -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.dat", "a.npy", "a.npz"])
@pytest.mark.parametrize(
    ("spikes", "error", "message"),
    [
        (torch.zeros(3, 5), ValueError, r"non-empty tensor of shape \(T, H, W\), got \(3, 5\)"),
        (torch.zeros(0, 3, 5), ValueError, "non-empty"),
        (torch.full((2, 3, 5), 2, dtype=torch.uint8), ValueError, "zeros and ones, got values from 2 to 2 in frame 0"),
        (torch.full((2, 3, 5), torch.nan), ValueError, "zeros and ones, got values from nan"),
        (torch.zeros(2, 3, 5, dtype=torch.complex64), TypeError, "real"),
        (np.zeros((2, 3, 5)), TypeError, "expected a tensor"),
    ],
)
def test_what_cannot_be_written(tmp_path, name, spikes, error, message):
    with pytest.raises(error, match=message):
        write_spikes(tmp_path / name, spikes)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a.dat", "a.npy", "a.npz"])
@pytest.mark.parametrize(
    ("chunks", "error", "message"),
    [
        ([], ValueError, "at least one chunk"),
        (5, TypeError, r"spikes: expected a tensor of shape \(T, H, W\), or chunks of it, got int"),
        ([torch.ones(2, 3, 5), torch.ones(2, 5, 3)], ValueError, r"frames of 3 x 5 as before, got \(2, 5, 3\)"),
        ([torch.ones(2, 3, 5), [1, 0]], TypeError, "expected a tensor of shape"),
        ([torch.ones(2, 3, 5), torch.full((3, 5), 2)], ValueError, "values from 2 to 2 in frame 2"),
    ],
)
def test_chunks_that_cannot_be_written(tmp_path, name, chunks, error, message):
    with pytest.raises(error, match=message):
        write_spikes(tmp_path / name, chunks)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a.dat", "a.npy", "a.npz"])
def test_chunks_that_fail_leave_the_old_file(tmp_path, name):
    """What the chunks raise comes out as it is."""
    spikes = random_spikes(3, 4, 5)
    write_spikes(tmp_path / name, spikes)

    def chunks():
        yield spikes
        raise FileNotFoundError("picture_7.png")

    with pytest.raises(FileNotFoundError, match="picture_7"):
        write_spikes(tmp_path / name, chunks())
    assert [file.name for file in tmp_path.iterdir()] == [name]
    assert read_spikes(tmp_path / name, 4, 5).equal(spikes)


def test_where_nothing_can_be_written(tmp_path):
    spikes = random_spikes(3, 4, 5)
    (tmp_path / "file").touch()
    (tmp_path / "folder.dat").mkdir()
    with pytest.raises(NotADirectoryError, match=r"a\.dat"):
        write_spikes(tmp_path / "file" / "a.dat", spikes)
    with pytest.raises(IsADirectoryError, match=r"folder\.dat"):
        write_spikes(tmp_path / "folder.dat", spikes)
    with pytest.raises(SpikeFileError, match=r"a\.png: expected a recording that ends in .dat, .npy, .npz, got .png"):
        write_spikes(tmp_path / "a.png", spikes)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["file", "folder.dat"]


# --- the field's own --------------------------------------------------------------------------------------------------


@needs_data
def test_simulated_recording(tmp_path):
    spikes = read_spikes(REDS, 250, 400, flip=True)
    assert spikes.shape == (301, 250, 400)
    sky, ground = spikes[:, :40, :200].float().mean(), spikes[:, 60:90, :180].float().mean()
    assert sky > 2 * ground  # a white awning over a dark roof: upright
    write_spikes(tmp_path / "again.dat", spikes, flip=True)
    assert (tmp_path / "again.dat").read_bytes() == REDS.read_bytes()


@needs_data
def test_real_recording():
    spikes = read_spikes(UHSR, 250, 250)
    with np.load(UHSR) as arrays:
        assert np.array_equal(spikes.numpy(), arrays["spk"])
    assert read_spikes(UHSR, start=150, frames=3).equal(spikes[150:153])

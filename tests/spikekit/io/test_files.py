"""Recordings: bits, rows, flips, parts of files, and invalid files."""

import tracemalloc

import numpy as np
import pytest
import torch

from spikekit import SpikeFileError, iter_spikes, read_spikes, spikes_shape, write_spikes
from spikekit.decoders.packing import pack_spikes


def random_spikes(*shape):
    return (torch.rand(shape) < 0.4).to(torch.uint8)


@pytest.fixture
def clip(tmp_path):
    """A recording of 5 frames of 3 x 5, 2 bytes each."""
    write_spikes(tmp_path / "clip.dat", random_spikes(5, 3, 5))
    return tmp_path / "clip.dat"


def test_bits_are_in_the_order_of_the_format(tmp_path):
    """The leftmost pixel is the least significant bit, rows share bytes, and frames are padded to whole bytes."""
    (tmp_path / "a.dat").write_bytes(bytes([0b00000001, 0b11000000, 0b00010010, 0b11111111]))
    expected = [
        [[1, 0, 0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0, 1, 1]],
        [[0, 1, 0, 0, 1, 0, 0, 0], [1, 1, 1, 1, 1, 1, 1, 1]],
    ]
    spikes = read_spikes(tmp_path / "a.dat", 2, 8)
    assert spikes.dtype is torch.uint8
    assert spikes.tolist() == expected
    assert read_spikes(tmp_path / "a.dat", 2, 8, flip=True).tolist() == [frame[::-1] for frame in expected]
    (tmp_path / "a.dat").write_bytes(bytes([0b10100001, 0b11111110, 0, 0b00000001]))
    assert read_spikes(tmp_path / "a.dat", 3, 3).tolist() == [
        [[1, 0, 0], [0, 0, 1], [0, 1, 0]],
        [[0, 0, 0], [0, 0, 0], [0, 0, 1]],
    ]
    spikes = torch.tensor([[[1, 0, 0], [0, 0, 1], [0, 1, 1]]])
    for flip, data in ((False, [0b10100001, 0b00000001]), (True, [0b01100110, 0b00000000])):
        write_spikes(tmp_path / "a.dat", spikes, flip=flip)
        assert (tmp_path / "a.dat").read_bytes() == bytes(data)
    write_spikes(tmp_path / "a.npz", spikes)
    with np.load(tmp_path / "a.npz") as arrays:
        assert (list(arrays), arrays["spk"].dtype, arrays["spk"].tolist()) == (["spk"], np.uint8, spikes.tolist())


@pytest.mark.parametrize("name", ["a.dat", "a.npy", "a.NPZ"])
@pytest.mark.parametrize("width", [1, 5, 16])
@pytest.mark.parametrize("flip", [False, True])
def test_write_and_read_whole_and_in_parts(tmp_path, name, width, flip):
    """Written at once, in chunks or by frames; read packed or not, whole, in part or in chunks."""
    spikes = random_spikes(11, 3, width).transpose(1, 2).contiguous().transpose(1, 2)
    dtypes = [torch.bool, torch.float32, torch.int64, torch.bfloat16, torch.float16, torch.float64] * 2
    ways = {
        "whole": spikes.float().requires_grad_(),
        "chunks": (part.to(dtype) for part, dtype in zip(spikes.split([1] * 6 + [3, 2]), dtypes, strict=False)),
        "frames": list(spikes),
    }
    for way, given in ways.items():
        path = tmp_path / "made" / way / name
        write_spikes(path, given, flip=flip)
        assert [file.name for file in path.parent.iterdir()] == [name]
        assert spikes_shape(path, 3, width) == (11, 3, width)
        assert read_spikes(str(path), 3, width, flip=flip).equal(spikes)
        assert read_spikes(path, 3, width, flip=not flip).equal(spikes.flip(-2))
    for options, whole in (({"flip": flip}, spikes), ({"flip": flip, "packed": True}, pack_spikes(spikes))):
        part = read_spikes(path, np.int32(3), width, **options, start=np.int64(4), frames=torch.tensor(3))
        assert part.equal(whole[4:7])
        assert torch.stack(list(iter_spikes(path, 3, width, **options))).equal(whole)
        chunks = list(iter_spikes(path, 3, width, **options, chunk=np.int64(4), start=1))
        assert torch.cat(chunks).equal(whole[1:])
        assert [len(chunk) for chunk in chunks] == [4, 4, 2]
        for tensor in (part, chunks[0]):
            assert tensor.is_contiguous()
            tensor.zero_()  # its own memory, and writable


@pytest.mark.parametrize("name", ["a.dat", "a.npy", "a.npz"])
def test_memory_is_bounded(tmp_path, name):
    """8 MB are written and read in chunks of 400 kB; two frames of 10 GB take the memory of two frames."""
    tracemalloc.start()
    write_spikes(tmp_path / name, (torch.ones(10, 100, 400, dtype=torch.uint8) for _ in range(20)))
    assert sum(int(part[:, 0, 0].sum()) for part in iter_spikes(tmp_path / name, 100, 400, chunk=10)) == 200
    peak = tracemalloc.get_traced_memory()[1]
    assert peak < 1_600_000
    if name == "a.dat":
        with open(tmp_path / name, "wb") as file:
            file.truncate(800_000 * 12_500)
            file.seek(700_000 * 12_500)
            file.write(b"\x01")
        tracemalloc.reset_peak()
        assert read_spikes(tmp_path / name, 250, 400, start=699_999, frames=2).nonzero().tolist() == [[1, 0, 0]]
        assert tracemalloc.get_traced_memory()[1] < 8 * 100_000
    tracemalloc.stop()


@pytest.mark.parametrize("dtype", ["bool", "int8", ">i2", "<u4", "float16", ">f4", "float64"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_of_any_dtype_and_order_are_read(tmp_path, dtype, order):
    spikes = random_spikes(4, 3, 5)
    np.savez(tmp_path / "a.npz", spk=np.asarray(spikes.numpy(), dtype=dtype, order=order))
    assert read_spikes(tmp_path / "a.npz").equal(spikes)
    assert read_spikes(tmp_path / "a.npz", start=1, frames=2, flip=True).equal(spikes[1:3].flip(-2))


@pytest.mark.parametrize("name", ["spk", "spikes", "anything"])
def test_array_is_found_by_its_name_or_shape(tmp_path, name):
    spikes = random_spikes(4, 3, 5)
    others = {"label": np.int64(3), "title": np.array("street"), "picture": np.zeros((3, 5))}
    others |= {} if name == "anything" else {"flow": np.zeros((2, 3, 5))}
    np.savez_compressed(tmp_path / "a.npz", **others, **{name: spikes.numpy()})
    assert spikes_shape(tmp_path / "a.npz") == (4, 3, 5)
    assert read_spikes(tmp_path / "a.npz", height=3).equal(spikes)


# --- what cannot be read or written -----------------------------------------------------------------------------------


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
def test_wrong_arrays_are_rejected(tmp_path, arrays, message):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(SpikeFileError, match=f"a.npz: .*{message}") as caught:
        read_spikes(tmp_path / "a.npz")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("read", [read_spikes, iter_spikes, spikes_shape])
def test_wrong_files_and_sizes_are_rejected(clip, read):
    """Errors that do not depend on the frames are raised at the call."""
    folder = clip.parent
    for name in ("empty.dat", "empty.npz"):
        (folder / name).touch()
    for name in ("clip.raw", "clip"):
        (folder / name).write_bytes(bytes(8))
    (folder / "folder.dat").mkdir()
    write_spikes(folder / "a.npz", random_spikes(2, 3, 5))
    for name, size, message in [
        ("none.dat", (3, 5), "no such file"),
        ("none.npz", (3, 5), "no such file"),
        ("folder.dat", (3, 5), "got a folder"),
        ("empty.dat", (3, 5), "empty file"),
        ("empty.npz", (3, 5), "empty file"),
        ("clip.raw", (3, 5), "ends in .dat, .npy, .npz, got .raw"),
        ("clip", (3, 5), "ends in .dat, .npy, .npz, got no ending"),
        ("clip.dat", (None, None), "no header, expected height and width, got None and None"),
        ("clip.dat", (0, 5), "at least 1, got 0 and 5"),
        ("clip.dat", (5, 5), "10 bytes at 4 bytes per frame give 2 whole frames and 2 extra bytes"),
        ("a.npz", (3, 6), "holds frames of 3 x 5, got height 3 and width 6"),
        ("a.npz", (4, None), "holds frames of 3 x 5, got height 4 and width None"),
    ]:
        with pytest.raises(SpikeFileError, match=f"{folder / name}: .*{message}"):
            read(folder / name, *size)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"height": 3.0}, TypeError, r"height: expected a whole number, got 3\.0"),
        ({"start": -1}, SpikeFileError, r"clip.dat: expected frames within 0 \.\. 4, got 6 from frame -1 on"),
        ({"start": 3, "frames": 3}, SpikeFileError, "got 3 from frame 3 on"),
        ({"frames": 6}, SpikeFileError, "got 6 from frame 0 on"),
    ],
)
def test_frames_out_of_range_are_rejected(clip, options, error, message):
    with pytest.raises(error, match=message):
        iter_spikes(clip, **{"height": 3, "width": 5} | options)


def test_a_file_truncated_while_it_is_read_is_reported(clip):
    frames = iter_spikes(clip, 3, 5)
    clip.write_bytes(b"")
    with pytest.raises(SpikeFileError, match=r"clip\.dat: truncated while it was read, at frame 0"):
        next(frames)


@pytest.mark.parametrize("name", ["a.dat", "a.npz"])
@pytest.mark.parametrize(
    ("spikes", "error", "message"),
    [
        (torch.zeros(3, 5), ValueError, r"non-empty tensor of shape \(T, H, W\), got \(3, 5\)"),
        (torch.full((2, 3, 5), 2, dtype=torch.uint8), ValueError, "zeros and ones, got values from 2 to 2 in frame 0"),
        (torch.full((2, 3, 5), torch.nan), ValueError, "zeros and ones, got values from nan"),
        ([], ValueError, "at least one chunk"),
        (5, TypeError, r"spikes: expected a tensor of shape \(T, H, W\), or chunks of it, got int"),
        ([torch.ones(2, 3, 5), torch.ones(2, 5, 3)], ValueError, "expected 3 x 5 as the first frame, got 5 x 3"),
        ([torch.ones(2, 3, 5), [1, 0]], TypeError, "expected a tensor of shape"),
        ([torch.ones(2, 3, 5), torch.full((3, 5), 2)], ValueError, "values from 2 to 2 in frame 2"),
        ("chunks", FileNotFoundError, "'picture_7.png'"),  # what the chunks raise stays as it is
    ],
)
def test_failed_write_keeps_the_old_file(tmp_path, name, spikes, error, message):
    write_spikes(tmp_path / name, old := random_spikes(3, 4, 5))
    with pytest.raises(error, match=message):
        write_spikes(tmp_path / name, map(open, ["picture_7.png"]) if isinstance(spikes, str) else spikes)
    assert [file.name for file in tmp_path.iterdir()] == [name]
    assert read_spikes(tmp_path / name, 4, 5).equal(old)

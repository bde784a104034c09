"""The cache of clips: damaged clips are not used, and packing is lossless."""

import warnings

import numpy as np
import pytest
import torch

from lightning_modules.data.cache import ClipCache, clip_key, pack_clip, unpack_clip

KEY = clip_key(frames=["a", "b"], scale=4)


def made_again():
    raise AssertionError("made again")


def same(one, other):
    return one.keys() == other.keys() and all(np.array_equal(one[n], other[n]) for n in other)


def test_cached_clip_is_returned(tmp_path):
    made = ClipCache(tmp_path / "new" / "folder").packed(KEY, lambda: clip(200))
    assert same(made, pack_clip(clip(200)))
    assert same(ClipCache(tmp_path / "new" / "folder").packed(KEY, made_again), made)
    with pytest.raises(AssertionError, match="made again"):
        ClipCache(tmp_path / "new" / "folder").packed(clip_key(frames=["b", "a"], scale=4), made_again)


@pytest.mark.parametrize("damage", [slice(0, 0), slice(0, 500), slice(0, -1), "a bit"])
def test_damaged_clip_is_made_again_with_one_warning(tmp_path, damage):
    made = ClipCache(tmp_path).packed(KEY, lambda: clip(200))
    (path,) = tmp_path.glob("*/*.npz")
    stored = bytearray(path.read_bytes())
    if damage == "a bit":
        stored[len(stored) // 2] ^= 1
    path.write_bytes(stored if damage == "a bit" else stored[damage])
    cache = ClipCache(tmp_path)
    with pytest.warns(UserWarning, match="cannot be read") as said:
        assert same(cache.packed(KEY, lambda: clip(200)), made)
    assert len(said) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert same(cache.packed(KEY, made_again), made)


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


@pytest.mark.parametrize(("levels", "dtype"), [(256, "uint8"), (257, "uint16"), (99999, "float32")])
@pytest.mark.parametrize("flow", [True, False])
def test_packing_is_lossless(levels, dtype, flow):
    original = clip(levels, 160, 170, flow=flow)
    packed = pack_clip(original)
    assert packed["rgb"].dtype == dtype
    assert packed["spikes"].nbytes == 41 * 160 * 22
    again = unpack_clip(packed, (0, 0, 160, 170), 2)
    assert again.keys() == original.keys()
    for name in again:
        assert again[name].dtype == original[name].dtype
        assert torch.equal(again[name], original[name]), name


@pytest.mark.parametrize("part", [(2, 8, 4, 8), (1, 7, 3, 2), (0, 6, 6, 13), (5, 21, 1, 1)])
def test_parts_are_unpacked(part):
    original, (top, left, height, width) = clip(200), part
    cut = unpack_clip(pack_clip(original), part, 2)
    rows, columns = slice(top, top + height), slice(left, left + width)
    assert torch.equal(cut["spikes"], original["spikes"][:, rows, columns])
    assert torch.equal(cut["flow"], original["flow"][:, :, rows, columns])
    rows, columns = slice(2 * top, 2 * (top + height)), slice(2 * left, 2 * (left + width))
    assert torch.equal(cut["rgb"], original["rgb"][:, rows, columns])

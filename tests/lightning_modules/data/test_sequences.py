"""Clips of films: content and seed determine them, in any process, with and without a cache."""

import functools
import shutil

import numpy as np
import pytest
import torch
from skimage import io

from lightning_modules.data.layouts import find_sequences
from lightning_modules.data.sequences import ClipRecipe, FilmScenes
from spikekit import bin_to_sensor, read_picture
from spikekit.flow.interpolate import FlowInterpolation
from spikekit.sensor.noise import SensorNoise

SMALL = {"scale": 2, "patch": 8, "batch_size": 2, "workers": 0}


def scenes(root, stage=None, **options):
    data = FilmScenes(str(root), **{**SMALL, **options})
    data.setup(stage)
    return data


def equal(one, other):
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def write_pan(folder, speed, size=(128, 192)):
    """Three frames of a picture that goes to the right."""
    folder.mkdir(parents=True)
    picture = np.random.default_rng(0).integers(0, 256, (40, 60, 3), "uint8").repeat(4, 0).repeat(4, 1)
    for n in range(3):
        left = 20 - speed * n
        io.imsave(folder / f"{n}.png", picture[: size[0], left : left + size[1]], check_contrast=False)


original_clip = ClipRecipe.clip


def test_shapes_and_types_of_a_clip(tmp_path, write_film):
    write_film(tmp_path / "film", 5, (37, 51))
    clip = scenes(tmp_path, clips=1).test_set[0]
    assert {name: (tuple(value.shape), value.dtype) for name, value in clip.items()} == {
        "spikes": ((41, 18, 24), torch.uint8),  # 37 x 51 without what 4 does not divide
        "rgb": ((3, 36, 48), torch.float32),
        "flow": ((2, 2, 18, 24), torch.float32),
    }
    assert torch.equal(clip["rgb"], read_picture(tmp_path / "film/00000002.png")[:, :36, :48])
    light = 0.4 * bin_to_sensor(clip["rgb"], scale=2)
    ground = (slice(0, 4), slice(0, 24))  # where no disc comes by
    assert (clip["spikes"].float().sum(0) - 41 * light)[ground].abs().max() < 1.001
    data = scenes(tmp_path, flow=False)
    assert all(set(batch) == {"spikes", "rgb"} for batch in data.train_dataloader())
    assert set(data.val_set[0]) == {"spikes", "rgb"}


@pytest.mark.parametrize("patch", [None, 8])
@pytest.mark.parametrize("pattern", ["RGGB", "grey"])
def test_key_frames_of_a_film(tmp_path, write_film, patch, pattern):
    write_film(tmp_path / "film", 11, (36, 48))
    data = scenes(tmp_path, clips=1, key_frames=3, pattern=pattern, cache=str(tmp_path / "cache"))
    channels = 1 if pattern == "grey" else 3
    for _ in ("fresh", "cached"):
        clip = data.test_set[0] if patch is None else data.train_set[0]
        side = (18, 24) if patch is None else (8, 8)
        assert clip["spikes"].shape == (3, 41, *side)
        assert clip["rgb"].shape == (3, channels, 2 * side[0], 2 * side[1])
        assert clip.keys() == {"spikes", "rgb", "every"}
        assert clip["every"] == 20
        assert clip["spikes"][0, 20:].equal(clip["spikes"][1, :21])  # one stream, cut
        light = 0.4 * bin_to_sensor(clip["rgb"], pattern, scale=2)
        assert (clip["spikes"].float().mean(1) - light)[:, :4].abs().max() < 0.05  # where no disc comes by
    truth = torch.stack([read_picture(tmp_path / f"film/{n:08d}.png")[:, :36, :48] for n in (4, 5, 6)])
    if pattern == "grey":  # the luminance
        truth = bin_to_sensor(truth, "grey", scale=1).unsqueeze(1)
    assert data.test_set[0]["rgb"].equal(truth)
    with pytest.raises(ValueError, match="key_frames: expected an odd number, got 2"):
        scenes(tmp_path, key_frames=2)


def test_clips_are_spread_over_a_film(tmp_path, write_film):
    write_film(tmp_path / "film", 22)
    data = scenes(tmp_path, clips=5)
    assert data.test_names == [f"film/{n:08d}" for n in (3, 7, 11, 15, 19)]
    assert scenes(tmp_path, clips=1).test_names == ["film/00000011"]
    assert len(scenes(tmp_path, clips=99).test_set) == 20
    assert scenes(tmp_path, clips=5, clocks=5).test_names[0] == "film/00000005"  # four frames before the middle
    frames = [int(name[-8:]) for name in data.train_set.names]
    assert [first <= n < end for n, (_, first, end) in zip(frames, data.train_set.places, strict=True)] == [True] * 5
    others = [int(name[-8:]) for name in scenes(tmp_path, clips=5, seed=1).train_set.names]
    assert frames != others


def test_patches_vary_and_keep_the_phase(tmp_path, monkeypatch, reds):
    reds(tmp_path)
    clips = scenes(tmp_path, clips=2).train_set
    whole = {}
    monkeypatch.setattr(ClipRecipe, "clip", lambda *of: whole.setdefault(of[1:], original_clip(*of)))
    corners = set()
    for index in range(12):
        patch = clips[index]
        turn, place = divmod(index, 4)
        everything = whole[clips.place(int(np.random.default_rng([0, turn]).permutation(4)[place]))]
        views = everything["rgb"].unfold(1, 16, 2).unfold(2, 16, 2)  # (3, 9, 17, 16, 16)
        ((top, left),) = (views == patch["rgb"][:, None, None]).all(dim=(0, 3, 4)).nonzero().tolist()
        assert top % 2 == left % 2 == 0
        corners.add((top, left))
        assert torch.equal(patch["spikes"], everything["spikes"][:, top : top + 8, left : left + 8])
        assert torch.equal(patch["flow"], everything["flow"][:, :, top : top + 8, left : left + 8].half().float())
    assert len(corners) > 5
    assert len(whole) == 4  # every film has two clips, and every round has all of them


def test_spikes_of_a_patch_include_the_margin(tmp_path, reds):
    """8 x 8 sensor pixels of a view of 16 x 24 have at most 4 around them."""
    reds(tmp_path)
    for flow_patch, side in ((8, 8), (11, 12), (48, 16)):
        clip = scenes(tmp_path, flow_patch=flow_patch).train_set[0]
        assert clip["spikes"].shape == (41, side, side)
        assert clip["rgb"].shape == (3, 16, 16)
        assert clip["flow"].shape == (2, 2, 8, 8)
        light = 0.4 * bin_to_sensor(clip["rgb"], scale=2)
        inner = clip["spikes"].float().mean(0)[side // 2 - 4 : side // 2 + 4, side // 2 - 4 : side // 2 + 4]
        assert torch.corrcoef(torch.stack([inner.flatten(), light.flatten()]))[0, 1] > 0.8


def test_flow_matches_the_film(tmp_path):
    write_pan(tmp_path / "film", 2)
    flow = scenes(tmp_path).test_set[0]["flow"]
    inside = flow[:, :, 16:-16, 16:-16].mean((2, 3))
    assert torch.allclose(inside, torch.tensor([[-0.75, 0.0], [0.75, 0.0]]), atol=0.15)  # x: 15 clocks, 2 / 2 / 20 each


def test_flow_is_zero_across_a_cut(tmp_path):
    write_pan(tmp_path / "film", 2, (64, 64))
    other = np.random.default_rng(1).integers(0, 256, (64, 64, 3), "uint8")
    io.imsave(tmp_path / "film" / "2.png", other, check_contrast=False)
    back, ahead = scenes(tmp_path).test_set[0]["flow"]
    assert back[0].mean() < -0.3
    assert not ahead.any()
    with pytest.raises(ValueError, match="interpolation"):
        scenes(tmp_path, interpolation=First()).test_set[0]


def test_noise_and_interpolation_reach_the_film(tmp_path):
    write_pan(tmp_path / "film", 6, (64, 64))
    plain = scenes(tmp_path).test_set[0]
    noisy = scenes(tmp_path, noise=SensorNoise(hot=0.2)).test_set[0]
    hot = noisy["spikes"].bool().all(0)
    assert 0.1 < hot.float().mean() < 0.3
    assert torch.equal(noisy["spikes"][:, ~hot], plain["spikes"][:, ~hot])
    still = scenes(tmp_path, interpolation=First(), flow=False, noise=SensorNoise()).test_set[0]
    assert torch.equal(still["rgb"], plain["rgb"])
    assert not torch.equal(still["spikes"], plain["spikes"])


class First:
    """An interpolation that shows the first frame throughout."""

    forward = backward = None

    def __call__(self, first, second):
        between = First()
        between.at = lambda tau: first if tau < 1 else second
        return between


@pytest.fixture
def film(tmp_path, write_film):
    write_film(tmp_path / "films" / "film", 5)
    return tmp_path / "films"


@pytest.fixture
def simulated(monkeypatch):
    """Every clip that was simulated."""
    seen = []

    @functools.wraps(original_clip)
    def counted(*args):
        seen.append(args)
        return original_clip(*args)

    monkeypatch.setattr(ClipRecipe, "clip", counted)
    return seen


def test_cached_clips_equal_fresh_ones(film, tmp_path, simulated):
    cache = str(tmp_path / "cache")
    fresh, cached = scenes(film, clips=1), scenes(film, clips=1, cache=cache)
    clips = len(fresh.test_set)
    for _ in range(2):
        assert all(equal(*pair) for pair in zip(fresh.test_set, cached.test_set, strict=True))
    assert len(simulated) == 3 * clips
    again = scenes(film, clips=1, cache=cache)
    assert all(equal(again.train_set[n], fresh.train_set[n]) for n in range(2))
    moved = shutil.copytree(film, tmp_path / "moved")
    simulated.clear()
    assert equal(scenes(moved, clips=1, cache=cache).test_set[0], cached.test_set[0])
    assert not simulated


def test_settings_change_the_cache_key(film):
    (one,) = find_sequences(film, lambda found: (found, found)).test
    changes = [
        {},
        {"scale": 1},
        {"frames": 39},
        {"pattern": "BGGR"},
        {"alpha": 0.41},
        {"clocks": 21},
        {"flow_times": (5, 34)},
        {"flow_times": ()},
        {"noise": SensorNoise(photons=100)},
        {"interpolation": FlowInterpolation(shrink=1)},
        {"seed": 1},
        {"key_frames": 3},
    ]
    keys = {ClipRecipe(**change).key(one, 2) for change in changes}
    assert len(keys) == len(changes)
    assert ClipRecipe().key(one, 2) in keys


def test_frames_change_the_cache_key(film, tmp_path, simulated, write_film):
    cache = str(tmp_path / "cache")
    scenes(film, cache=cache, clips=1).test_set[0]
    for first, count in ((4, 1), (3, 2)):  # not a frame of the clip, and one
        write_film(film / "film", 1, seed=3, first=first)
        scenes(film, cache=cache, clips=1).test_set[0]
        assert len(simulated) == count

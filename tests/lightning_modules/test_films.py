"""Films: every layout is found by its files, and a clip is the same by content and seed, from the cache or fresh."""

import csv
import functools
import re
import shutil
import sys
import types
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from skimage import io

from lightning_modules.cli import main
from lightning_modules.data.films import ClipRecipe, FilmClips, FilmScenes
from lightning_modules.data.layouts import find_films
from spikekit import bin_to_sensor, mosaic, psnr, read_picture
from spikekit.noise import SensorNoise

SHARED = Path(__file__).parents[2].parent / "shared" / "data"
SMALL = {"scale": 2, "patch": 8, "batch_size": 2, "workers": 0}


def write_film(folder, count, size=(32, 48), name="{:08d}.png", seed=0, first=0):
    """A disc that moves over noise by a pixel a frame."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([seed, len(str(folder))])
    ground = rng.integers(40, 160, (*size, 3), "uint8")
    y, x = np.mgrid[: size[0], : size[1]]
    for n in range(first, first + count):
        picture = ground.copy()
        picture[(y - size[0] / 2) ** 2 + (x - 10 - n) ** 2 < 36] = 230
        io.imsave(folder / name.format(n), picture, check_contrast=False)


def write_pan(folder, speed, size=(128, 192)):
    """Three frames of a picture that goes to the right."""
    folder.mkdir(parents=True)
    picture = np.random.default_rng(0).integers(0, 256, (40, 60, 3), "uint8").repeat(4, 0).repeat(4, 1)
    for n in range(3):
        left = 20 - speed * n
        io.imsave(folder / f"{n}.png", picture[: size[0], left : left + size[1]], check_contrast=False)


def reds(root, train="train/train_orig", val="val/val_orig", scenes=(2, 1), count=9):
    for split, there in ((train, scenes[0]), (val, scenes[1])):
        for scene in range(there):
            write_film(root / split / f"{scene:03d}", count, seed=scene)


def septuplets(root, names, folder="sequences", size=(64, 96), frames=range(1, 8)):
    for seed, name in enumerate(names):
        write_film(root / folder / name, len(frames), size, "im{}.png", seed, frames[0])


def scenes(root, stage=None, **options):
    data = FilmScenes(str(root), **{**SMALL, **options})
    data.setup(stage)
    return data


def names(films):
    return [film.name for film in films]


def found(root):
    return find_films(root, lambda films: (films[1:], films[:1]))


def equal(one, other):
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


# --- layouts ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("train", "val"),
    [
        ("train/train_orig", "val/val_orig"),
        ("train_orig", "val_orig"),
        ("train_orig_part3/train/train_orig", "val_orig_part0/val/val_orig"),
        ("train_orig_part15/train_orig", "val_orig_part1/val_orig"),
        ("train", "val"),
    ],
)
def test_reds(tmp_path, train, val):
    reds(tmp_path, train, val)
    films = found(tmp_path)
    assert (films.name, films.clips, films.scale) == ("REDS", 5, None)
    assert names(films.train) == ["000", "001"]
    assert names(films.val) == names(films.test) == ["000"]
    assert films.train[1].folder == tmp_path / train / "001"
    assert films.train[1].frames == tuple(f"{n:08d}.png" for n in range(9))


def test_reds_in_parts(tmp_path):
    for part in range(2):
        write_film(tmp_path / f"train_orig_part{part}/train/train_orig/{15 * part:03d}", 3)
    write_film(tmp_path / "val/val_orig/007", 3)
    films = found(tmp_path)
    assert names(films.train) == ["000", "015"]
    assert names(films.val) == ["007"]


@pytest.mark.parametrize("folder", ["GT", "."])
def test_vid4_is_for_tests(tmp_path, folder):
    for name in ("walk", "city"):
        write_film(tmp_path / folder / name, 5)
    if folder == "GT":
        write_film(tmp_path / "BIx4" / "walk", 5, (8, 12))
    films = found(tmp_path)
    assert (films.name, films.clips, films.train) == ("Vid4", 1, ())
    assert names(films.test) == ["city", "walk"]
    assert films.test[1].folder == tmp_path / folder / "walk"
    assert scenes(tmp_path, "test").test_names == ["city/00000002", "walk/00000002"]
    with pytest.raises(FileNotFoundError, match=r"Vid4 without films for fit \(train\)"):
        scenes(tmp_path, "fit")


def test_vimeo_septuplets(tmp_path):
    septuplets(tmp_path, ["00001/0001", "00001/0002", "00002/0001"])
    (tmp_path / "sep_trainlist.txt").write_text("00001/0001\n00002/0001\n")
    (tmp_path / "sep_testlist.txt").write_text("00001/0002\n\n")
    for root in (tmp_path, tmp_path.parent / "up"):
        films = found(root)
        assert (films.name, films.clips, films.scale) == ("Vimeo-90K", 1, 4)
        assert names(films.train) == ["00001/0001", "00002/0001"]
        assert names(films.val) == names(films.test) == ["00001/0002"]
        assert (films.test[0].folder, films.test[0].shrink) == (tmp_path / "sequences/00001/0002", 4)
        if root is tmp_path:
            (tmp_path.parent / "up").mkdir()
            tmp_path = tmp_path.rename(tmp_path.parent / "up" / "vimeo_septuplet")


@pytest.mark.parametrize("small", ["BIx4", "../vimeo_septuplet_matlabLRx4/sequences"])
def test_vimeo_with_small_frames(tmp_path, small):
    root = tmp_path / "vimeo_septuplet"
    septuplets(root, ["00001/0001"])
    septuplets(root, ["00001/0001"], small, (16, 24))
    for split in ("train", "test"):
        (root / f"sep_{split}list.txt").write_text("00001/0001\n")
    (film,) = found(root).train
    assert film.folder.samefile(root / small / "00001/0001")
    assert (film.truth, film.shrink) == (root / "sequences/00001/0001", 1)


def test_vimeo_test_set(tmp_path):
    septuplets(tmp_path, ["00001/0266"], "low_resolution", (16, 24))
    septuplets(tmp_path, ["00001/0266"], "target", frames=[4])
    (tmp_path / "sep_testlist.txt").write_text("00001/0266")
    films = found(tmp_path)
    assert (names(films.train), names(films.test)) == ([], ["00001/0266"])
    data = scenes(tmp_path, "test", scale=4)
    assert data.test_names == ["00001/0266/im4"]
    clip = data.test_set[0]
    assert {name: tuple(value.shape) for name, value in clip.items()} == {
        "spikes": (41, 16, 24),
        "rgb": (3, 64, 96),
        "flow": (2, 2, 16, 24),
    }
    assert torch.equal(clip["rgb"], read_picture(tmp_path / "target/00001/0266/im4.png"))
    # the camera sees the small frames, pixel by pixel
    seen = mosaic(read_picture(tmp_path / "low_resolution/00001/0266/im4.png"))
    other = mosaic(read_picture(tmp_path / "low_resolution/00001/0266/im7.png"))
    rate = clip["spikes"].float().mean(0) / 0.4
    assert (rate - seen).square().mean() < (rate - other).square().mean()
    assert (rate - seen).abs().median() < 1 / 41 / 0.4


def test_vimeo_made_small(tmp_path):
    septuplets(tmp_path, ["00001/0001"])
    (tmp_path / "sep_testlist.txt").write_text("00001/0001")
    clip = scenes(tmp_path, "test", scale=4).test_set[0]
    truth = read_picture(tmp_path / "sequences/00001/0001/im4.png")
    assert torch.equal(clip["rgb"], truth)
    assert clip["spikes"].shape == (41, 16, 24)
    small = torch.nn.functional.interpolate(truth[None], scale_factor=0.25, mode="bicubic", antialias=True)[0]
    assert (clip["spikes"].float().mean(0) / 0.4 - mosaic(small)).abs().median() < 1 / 41 / 0.4


def test_other_films(tmp_path):
    for name in ("a2", "a10", "b"):
        write_film(tmp_path / name, 3, name="f{}.png", first=9)
    write_film(tmp_path / ".hidden", 3)
    (tmp_path / "notes").mkdir()
    films = found(tmp_path)
    assert (films.name, films.clips) == ("films", 5)
    assert names(films.test) == ["a2", "a10", "b"]
    assert (names(films.train), names(films.val)) == (["a10", "b"], ["a2"])
    assert films.test[0].frames == ("f9.png", "f10.png", "f11.png")
    assert names(found(tmp_path / "b").test) == ["b"]  # one film alone


def test_what_is_missing_is_shown(tmp_path):
    empty = tmp_path / "empty"
    (empty / "train").mkdir(parents=True)
    for root in (empty, tmp_path / "nowhere"):
        with pytest.raises(FileNotFoundError, match=re.escape(str(root))) as error:
            found(root)
    with pytest.raises(FileNotFoundError, match="expected one of") as error:
        found(empty)
    for layout in ("train/train_orig/000/", "GT/calendar/", "sep_trainlist.txt", "low_resolution/", "NAME/FRAME.png"):
        assert layout in str(error.value)
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError, match="expected a folder of films, got a file"):
        found(tmp_path / "file")
    reds(tmp_path / "reds", scenes=(1, 0))
    with pytest.raises(FileNotFoundError, match=r"REDS without films for fit \(val\)"):
        scenes(tmp_path / "reds", "fit")


def test_a_listed_sequence_is_missing(tmp_path):
    septuplets(tmp_path, ["00001/0001"])
    (tmp_path / "sep_testlist.txt").write_text("00001/0001\n00001/0009\n00003/0001")
    with pytest.raises(FileNotFoundError, match=r"2 of 3 sequences are not in .*sequences, the first is 00001/0009"):
        found(tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 11}, "batch_size: expected at most the 10 training clips"),
        ({"alpha": 0}, "alpha: expected a finite number above 0"),
        ({"clips": -1}, "clips: expected a whole number >= 1"),
        ({"flow_times": (5, 41)}, r"flow_times: expected clocks in \[0, 41\)"),
        ({"pattern": "RGB"}, "pattern"),
        ({"seed": -1}, "seed: expected 0 or more"),
        ({"frames": 201}, "000: expected at least 11 frames for a clip, got 9"),
    ],
)
def test_arguments_that_make_no_sense(tmp_path, options, message):
    reds(tmp_path)
    with pytest.raises(ValueError, match=message):
        scenes(tmp_path, "fit", **options)


def test_vimeo_is_for_four(tmp_path):
    septuplets(tmp_path, ["00001/0001"])
    (tmp_path / "sep_testlist.txt").write_text("00001/0001")
    with pytest.raises(ValueError, match="scale: expected 4 with Vimeo-90K"):
        scenes(tmp_path, "test", scale=2)


def test_bad_files_are_named(tmp_path):
    write_film(tmp_path / "a", 3)
    write_film(tmp_path / "b", 3)
    (tmp_path / "a" / "00000001.png").write_bytes(b"no picture")
    write_film(tmp_path / "b", 1, (32, 50), first=2)
    clips = scenes(tmp_path).test_set
    with pytest.raises(ValueError, match=r"a/00000001\.png"):
        clips[0]
    with pytest.raises(ValueError, match="expected 32 x 48"):
        clips[1]
    write_film(tmp_path / "b", 3)
    train = FilmClips(found(tmp_path / "b").test, ClipRecipe(scale=2), patch=18)
    with pytest.raises(ValueError, match=r"patch: expected at most 16, as .* gives 16 x 24 sensor pixels at scale 2"):
        train[0]


# --- clips ------------------------------------------------------------------------------------------------------------


def test_a_clip_is_what_the_network_reads(tmp_path):
    write_film(tmp_path / "film", 5, (37, 51))
    data = scenes(tmp_path, clips=1)
    clip = data.test_set[0]
    assert {name: (tuple(value.shape), value.dtype) for name, value in clip.items()} == {
        "spikes": ((41, 18, 24), torch.uint8),  # 37 x 51 without what 4 does not divide
        "rgb": ((3, 36, 48), torch.float32),
        "flow": ((2, 2, 18, 24), torch.float32),
    }
    assert torch.equal(clip["rgb"], read_picture(tmp_path / "film/00000002.png")[:, :36, :48])
    light = 0.4 * bin_to_sensor(clip["rgb"], scale=2)
    ground = (slice(0, 4), slice(0, 24))  # where no disc comes by
    assert (clip["spikes"].float().sum(0) - 41 * light)[ground].abs().max() < 1.001


def test_clips_are_spread_over_a_film(tmp_path):
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


def test_patches_keep_the_phase_and_are_others_every_time(tmp_path, monkeypatch):
    reds(tmp_path)
    clips = scenes(tmp_path, clips=2).train_set
    whole = {}
    monkeypatch.setattr(
        ClipRecipe, "clip", lambda self, film, n: whole.setdefault((film, n), clip_of(self, film, n)), raising=True
    )
    corners = set()
    for index in range(12):
        patch = clips[index]
        turn, place = divmod(index, 4)
        film, middle = clips.place(int(np.random.default_rng([0, turn]).permutation(4)[place]))
        everything = whole[film, middle]
        fits = [
            (top, left)
            for top in range(9)
            for left in range(17)
            if torch.equal(patch["rgb"], everything["rgb"][:, 2 * top : 2 * top + 16, 2 * left : 2 * left + 16])
        ]
        ((top, left),) = fits
        assert top % 2 == left % 2 == 0
        corners.add((top, left))
        assert torch.equal(patch["spikes"], everything["spikes"][:, top : top + 8, left : left + 8])
        assert torch.equal(patch["flow"], everything["flow"][:, :, top : top + 8, left : left + 8].half().float())
    assert len(corners) > 5
    assert len(whole) == 4  # every film has two clips, and every round has all of them


original_clip = ClipRecipe.clip


def clip_of(recipe, film, middle):
    return original_clip(recipe, film, middle)


def test_chance_is_that_of_the_content_and_the_seed(tmp_path):
    write_film(tmp_path / "one" / "film", 3)
    shutil.copytree(tmp_path / "one" / "film", tmp_path / "two" / "elsewhere")
    first = scenes(tmp_path / "one").test_set[0]
    torch.manual_seed(3)
    assert equal(scenes(tmp_path / "two").test_set[0], first)
    assert not torch.equal(scenes(tmp_path / "one", seed=1).test_set[0]["spikes"], first["spikes"])
    write_film(tmp_path / "two" / "elsewhere", 1, first=2, seed=5)
    assert not torch.equal(scenes(tmp_path / "two").test_set[0]["spikes"], first["spikes"])


def test_without_flow(tmp_path):
    reds(tmp_path)
    data = scenes(tmp_path, flow=False)
    assert all(set(batch) == {"spikes", "rgb"} for batch in data.train_dataloader())
    assert set(data.val_set[0]) == {"spikes", "rgb"}


def test_flow_is_that_of_the_film(tmp_path):
    write_pan(tmp_path / "film", 2)
    flow = scenes(tmp_path).test_set[0]["flow"]
    inside = flow[:, :, 16:-16, 16:-16].mean((2, 3))
    assert torch.allclose(inside, torch.tensor([[-0.75, 0.0], [0.75, 0.0]]), atol=0.15)  # x: 15 clocks, 2 / 2 / 20 each


def test_there_is_no_flow_beyond_a_cut(tmp_path):
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


# --- data module ------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:This DataLoader will create")
def test_same_clips_whatever_the_workers(tmp_path):
    reds(tmp_path)
    alone = scenes(tmp_path, clips=2)
    expected = list(alone.train_dataloader())
    assert [len(batch["spikes"]) for batch in expected] == [2, 2]
    assert torch.equal(expected[1]["rgb"][0], alone.train_set[2]["rgb"])
    for workers in (1, 2):
        data = scenes(tmp_path, clips=2, workers=workers, cache=str(tmp_path / "cache"))
        loader = data.train_dataloader()
        assert loader.num_workers == workers
        for _ in range(2):
            assert all(equal(*pair) for pair in zip(loader, expected, strict=True))
        val = zip(data.val_dataloader(), alone.val_dataloader(), strict=True)
        assert all(equal(*pair) for pair in val)
    assert len(list((tmp_path / "cache").glob("*/*.clip"))) == 6


def test_spawned_workers_make_the_same_clips(tmp_path):
    write_film(tmp_path / "film", 4)
    loader = scenes(tmp_path, workers=1).test_dataloader()
    loader.multiprocessing_context = "spawn"
    assert all(equal(*pair) for pair in zip(loader, scenes(tmp_path).test_dataloader(), strict=True))


def test_training_goes_on_where_it_stands(tmp_path):
    reds(tmp_path)
    data = scenes(tmp_path, "fit", clips=2)
    sampler = data.train_dataloader().sampler
    assert list(sampler) == [0, 1, 2, 3]
    data.trainer = types.SimpleNamespace(global_step=3, accumulate_grad_batches=1, world_size=1)
    assert list(sampler) == [6, 7, 8, 9]


# --- cache ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def film(tmp_path):
    write_film(tmp_path / "films" / "film", 5)
    return tmp_path / "films"


@pytest.fixture
def simulated(monkeypatch):
    """How many clips were simulated."""
    count = types.SimpleNamespace(clips=0)

    @functools.wraps(original_clip)
    def counted(*args):
        count.clips += 1
        return original_clip(*args)

    monkeypatch.setattr(ClipRecipe, "clip", counted)
    return count


def test_cached_clips_equal_fresh_ones(film, tmp_path, simulated):
    fresh = scenes(film)
    cached = scenes(film, cache=str(tmp_path / "cache"))
    clips = len(fresh.test_set)
    for _ in range(2):
        assert all(equal(*pair) for pair in zip(fresh.test_set, cached.test_set, strict=True))
    assert simulated.clips == 3 * clips
    again = scenes(film, cache=str(tmp_path / "cache"))
    assert all(equal(again.train_set[n], fresh.train_set[n]) for n in range(4))
    moved = shutil.copytree(film, tmp_path / "moved")
    simulated.clips = 0
    assert equal(scenes(moved, cache=str(tmp_path / "cache")).test_set[0], cached.test_set[0])
    assert simulated.clips == 0


@pytest.mark.parametrize(
    "changed",
    [
        {"scale": 1},
        {"frames": 39},
        {"pattern": "BGGR"},
        {"alpha": 0.41},
        {"clocks": 21},
        {"flow_times": (5, 34)},
        {"flow": False},
        {"noise": SensorNoise(photons=100)},
        {"interpolation": First(), "flow": False},
        {"seed": 1},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_another_setting_is_another_clip(film, tmp_path, simulated, changed):
    cache = str(tmp_path / "cache")
    scenes(film, cache=cache, clips=1).test_set[0]
    clip = scenes(film, cache=cache, clips=1, **changed).test_set[0]
    assert simulated.clips == 2
    assert equal(clip, scenes(film, cache=cache, clips=1, **changed).test_set[0])
    assert simulated.clips == 2
    scenes(film, cache=cache, clips=1).test_set[0]
    assert simulated.clips == 2


def test_other_frames_are_another_clip(film, tmp_path, simulated):
    cache = str(tmp_path / "cache")
    scenes(film, cache=cache, clips=1).test_set[0]
    write_film(film / "film", 1, seed=3, first=4)  # not a frame of the clip
    scenes(film, cache=cache, clips=1).test_set[0]
    assert simulated.clips == 1
    write_film(film / "film", 1, seed=3, first=3)
    scenes(film, cache=cache, clips=1).test_set[0]
    assert simulated.clips == 2


def test_a_damaged_clip_is_made_again(film, tmp_path, simulated):
    cache = tmp_path / "cache"
    clips = scenes(film, cache=str(cache), clips=1).test_set
    fresh = clips[0]
    (path,) = cache.glob("*/*.clip")
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.warns(UserWarning, match="damaged, made again"):
        assert equal(clips[0], fresh)
    assert simulated.clips == 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert equal(clips[0], fresh)
    assert simulated.clips == 2


# --- the command ------------------------------------------------------------------------------------------------------

TINY = {
    "model": {
        "network": {
            "init_args": dict.fromkeys(
                ("width", "representation_width", "features", "stages", "blocks", "end_blocks"), 1
            )
        }
    },
    "data": {"init_args": {"patch": 8, "batch_size": 2, "workers": 0}},
    "trainer": {"max_steps": 2, "enable_progress_bar": False, "log_every_n_steps": 1, "check_val_every_n_epoch": 1},
}


@pytest.fixture
def command(tmp_path, configs, monkeypatch):
    """Run the command with a tiny network, after the overlay of a data set, in a folder of its own."""
    monkeypatch.setattr(sys, "argv", ["lightning"])
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(TINY))

    def run(verb, overlay, *args, scale=2):
        tiny = str(tmp_path / "tiny.yaml")
        configurations = [str(configs / f"x{scale}.yaml"), str(configs / "data" / f"{overlay}.yaml"), tiny]
        main([verb, *(part for path in configurations for part in ("-c", path)), *map(str, args)])

    return run


@pytest.mark.slow
def test_fit_and_test_on_reds(tmp_path, command, capsys):
    reds(tmp_path / "reds", count=7)
    root = "--data.root", tmp_path / "reds"
    command("fit", "reds", *root, "-o", tmp_path / "run", "--trainer.max_steps", 5)
    assert len(list((tmp_path / "runs" / "clips").glob("*/*.clip"))) == 15
    config = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())["data"]
    assert config["class_path"] == "lightning_modules.data.FilmScenes"
    assert config["init_args"]["cache"] == "runs/clips"
    command("test", "reds", *root, "-o", tmp_path / "run", "--ckpt_path", "best", "--data.seed", 1)
    assert "mean of 5 clips" in capsys.readouterr().out


def test_the_data_follow_the_network(command, monkeypatch):
    def stop(self, stage):
        raise ValueError(f"{stage}: {self.options}")

    monkeypatch.setattr(FilmScenes, "setup", stop)
    network = [f"--model.network.{name}" for name in ("alpha=0.3", "frames=39", "window=9")]
    with pytest.raises(SystemExit) as exit:
        command("validate", "reds", "--data.root", "nowhere", *network, scale=3)
    for option in ("validate:", "'scale': 3,", "'frames': 39,", "'alpha': 0.3,", "'flow_times': (4, 34),"):
        assert option in str(exit.value)


@pytest.mark.slow
def test_test_on_vid4_prints_every_clip(tmp_path, command, capsys):
    write_film(tmp_path / "vid4/GT/walk", 3)
    write_film(tmp_path / "vid4/GT/city", 3, (40, 32))
    command("test", "vid4", "--data.root", tmp_path / "vid4", "-o", tmp_path / "run")
    printed = capsys.readouterr().out
    assert re.findall(r"SSIM   (.*)", printed) == ["mean of 2 clips", "city/00000001", "walk/00000001"]
    rows = list(csv.DictReader((tmp_path / "run" / "test.csv").open()))
    assert [row["clip"] for row in rows] == ["city/00000001", "walk/00000001", "mean"] * 4
    assert [row["method"] for row in rows[::3]] == ["TFI", "TFP", "CSCSR", "CSCSR, true flow"]
    assert all(f"{float(row['psnr']):.2f}" in printed for row in rows)


@pytest.mark.slow
def test_fit_on_vimeo_and_on_films_without_flow(tmp_path, command):
    septuplets(tmp_path / "vimeo", ["00001/0001", "00001/0002", "00002/0001"])
    (tmp_path / "vimeo/sep_trainlist.txt").write_text("00001/0001\n00002/0001\n")
    (tmp_path / "vimeo/sep_testlist.txt").write_text("00001/0002\n")
    command("fit", "vimeo90k", "--data.root", tmp_path / "vimeo", "-o", tmp_path / "run", scale=4)
    for name in ("a", "b"):
        write_film(tmp_path / "films" / name, 4)
    interpolation = "--data.interpolation", "spikekit.interpolate.Blend"
    command("fit", "films", "--data.root", tmp_path / "films", "--data.flow", "false", *interpolation, "-o", "other")
    assert (tmp_path / "other" / "checkpoints" / "best.ckpt").is_file()


@pytest.mark.parametrize(
    ("verb", "overlay", "args", "message"),
    [
        ("fit", "reds", ["--data.root", "nowhere"], "nowhere: no such folder of films"),
        ("fit", "reds", ["--data.root", "."], "expected one of\n  REDS 120 fps   train/train_orig/000/"),
        ("test", "reds", ["--data.root", "vid4", "--data.pattern", "BGGR"], "data.pattern: expected RGGB"),
        ("fit", "vid4", ["--data.root", "vid4"], "Vid4 without films for fit"),
        ("predict", "vid4", ["--data.root", "vid4"], "--data Recording --data.path FILE"),
    ],
)
def test_errors_come_before_anything_is_written(tmp_path, command, verb, overlay, args, message):
    write_film(tmp_path / "vid4" / "walk", 3)
    if args[1] == ".":
        shutil.rmtree(tmp_path / "vid4")
    with pytest.raises(SystemExit) as exit:
        command(verb, overlay, *args, "-o", tmp_path / "run")
    assert str(exit.value).startswith("lightning: ")
    assert message in str(exit.value)
    assert not (tmp_path / "run").exists()


def test_overlays_name_what_there_is(configs):
    for path in sorted((configs / "data").glob("*.yaml")):
        data = yaml.safe_load(path.read_text())["data"]
        assert data["class_path"] == "FilmScenes"
        FilmScenes(root="", **data["init_args"])


# --- real films -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_decoders_on_vid4():
    if not (SHARED / "video" / "vid4").is_dir():
        pytest.skip("no films of Vid4 beside the checkout")
    from lightning_modules.networks import ClassicalDecoder

    data = scenes(SHARED / "video" / "vid4", "test", scale=4)
    assert data.test_names == ["foliage/00000024", "walk/00000023"]
    clips = [data.test_set[n] for n in range(2)]
    for method, expected in (("tfi", [20.2, 21.9]), ("tfp", [20.7, 22.5])):
        decode = ClassicalDecoder(method, 4)
        measured = [psnr(decode(clip["spikes"][None]), clip["rgb"][None]).item() for clip in clips]
        assert measured == pytest.approx(expected, abs=0.3)

"""Layouts of data sets: recognised by their files, and shown in error messages."""

import re

import pytest
import torch

from lightning_modules.data.layouts import find_sequences
from lightning_modules.data.sequences import ClipRecipe, FilmScenes, SequenceClips
from spikekit import VideoError, mosaic, read_picture

SMALL = {"scale": 2, "patch": 8, "batch_size": 2, "workers": 0}


def scenes(root, stage=None, **options):
    data = FilmScenes(str(root), **{**SMALL, **options})
    data.setup(stage)
    return data


def names(films):
    return [film.name for film in films]


def found(root):
    return find_sequences(root, lambda films: (films[1:], films[:1]))


@pytest.mark.parametrize(
    ("train", "val"),
    [
        ("train/train_orig", "val/val_orig"),
        ("train_orig", "val_orig"),
        ("train_orig_part15/train_orig", "val_orig_part1/val_orig"),
    ],
)
def test_sequences_of_reds_are_found(tmp_path, train, val, reds):
    reds(tmp_path, train, val)
    films = found(tmp_path)
    assert (films.name, films.clips, films.scale) == ("REDS", 5, None)
    assert names(films.train) == ["000", "001"]
    assert names(films.val) == names(films.test) == ["000"]
    assert films.train[1].folder == tmp_path / train / "001"
    assert films.train[1].frames == tuple(f"{n:08d}.png" for n in range(9))


@pytest.mark.parametrize("folder", ["GT", "."])
def test_vid4_is_for_tests(tmp_path, folder, write_film):
    for name in ("walk", "city"):
        write_film(tmp_path / folder / name, 5)
    if folder == "GT":
        write_film(tmp_path / "BIx4" / "walk", 5, (8, 12))
    films = found(tmp_path)
    assert (films.name, films.clips, films.train) == ("Vid4", 1, ())
    assert names(films.test) == ["city", "walk"]
    assert films.test[1].folder == tmp_path / folder / "walk"
    assert scenes(tmp_path, "test").test_names == ["city/00000002", "walk/00000002"]
    with pytest.raises(FileNotFoundError, match=r"Vid4 without sequences for fit \(train\)"):
        scenes(tmp_path, "fit")


@pytest.mark.parametrize("small", [None, "BIx4", "../vimeo_septuplet_matlabLRx4/sequences"])
def test_septuplets_of_vimeo_are_found(tmp_path, small, septuplets):
    root = tmp_path / "vimeo_septuplet"
    septuplets(root, ["00001/0001", "00001/0002", "00002/0001"])
    (root / "sep_trainlist.txt").write_text("00001/0001\n00002/0001\n")
    (root / "sep_testlist.txt").write_text("00001/0002\n\n")
    if small:
        septuplets(root, ["00001/0001", "00001/0002", "00002/0001"], small, (16, 24))
    for typed in (root, tmp_path):
        films = found(typed)
        assert (films.name, films.clips, films.scale) == ("Vimeo-90K", 1, 4)
        assert names(films.train) == ["00001/0001", "00002/0001"]
        assert names(films.val) == names(films.test) == ["00001/0002"]
        (film,) = films.test
        assert film.folder.samefile(root / (small or "sequences") / "00001/0002")
        assert (film.truth, film.shrink) == (root / "sequences/00001/0002", 1 if small else 4)


@pytest.mark.parametrize("made_small", [False, True])
def test_camera_sees_low_resolution_frames_of_vimeo(tmp_path, made_small, septuplets):
    large = tmp_path / ("sequences" if made_small else "target") / "00001/0266/im4.png"
    septuplets(tmp_path, ["00001/0266"], large.parts[-4], frames=range(1, 8) if made_small else [4])
    if not made_small:
        septuplets(tmp_path, ["00001/0266"], "low_resolution", (16, 24))
    (tmp_path / "sep_testlist.txt").write_text("00001/0266")
    data = scenes(tmp_path, "test", scale=4)
    assert (names(data.found.train), data.test_names) == ([], ["00001/0266/im4"])
    clip, truth = data.test_set[0], read_picture(large)
    assert clip["spikes"].shape == (41, 16, 24)
    assert clip["flow"].shape == (2, 2, 16, 24)
    assert torch.equal(clip["rgb"], truth)
    small = torch.nn.functional.interpolate(truth[None], scale_factor=0.25, mode="bicubic", antialias=True)[0]
    small = small if made_small else read_picture(tmp_path / "low_resolution/00001/0266/im4.png")
    assert (clip["spikes"].float().mean(0) / 0.4 - mosaic(small)).abs().median() < 1 / 41 / 0.4
    with pytest.raises(ValueError, match="scale: expected 4 with Vimeo-90K"):
        scenes(tmp_path, "test", scale=2)
    (tmp_path / "sep_testlist.txt").write_text("00001/0266\n00001/0009\n00003/0001")
    with pytest.raises(FileNotFoundError, match=r"2 of 3 sequences are not in .*, the first is 00001/0009"):
        found(tmp_path)


def test_other_films_are_found(tmp_path, write_film):
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


def test_missing_folders_are_reported(tmp_path, reds):
    empty = tmp_path / "empty"
    (empty / "train").mkdir(parents=True)
    for root in (empty, tmp_path / "nowhere"):
        with pytest.raises(FileNotFoundError, match=re.escape(str(root))):
            found(root)
    with pytest.raises(FileNotFoundError, match="expected one of"):
        found(empty)
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError, match="expected a folder of films, got a file"):
        found(tmp_path / "file")
    reds(tmp_path / "reds", scenes=(1, 0))
    with pytest.raises(FileNotFoundError, match=r"REDS without sequences for fit \(val\)"):
        scenes(tmp_path / "reds", "fit")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 11}, "batch_size: expected at most the 10 training clips"),
        ({"flow_times": (5, 41)}, r"flow_times: expected clocks in \[0, 41\)"),
        ({"frames": 201}, "000: expected at least 11 frames for a clip, got 9"),
    ],
)
def test_invalid_arguments_are_rejected(tmp_path, options, message, reds):
    reds(tmp_path)
    with pytest.raises(ValueError, match=message):
        scenes(tmp_path, "fit", **options)


def test_bad_files_are_named(tmp_path, write_film):
    write_film(tmp_path / "a", 3)
    write_film(tmp_path / "b", 3)
    (tmp_path / "a" / "00000001.png").write_bytes(b"no picture")
    write_film(tmp_path / "b", 1, (32, 50), first=2)
    clips = scenes(tmp_path).test_set
    # of our own class, which the command shows as one line
    with pytest.raises(VideoError, match=r"a/00000001\.png"):
        clips[0]
    with pytest.raises(
        VideoError, match=r"b/00000002\.png: expected 32 x 48 \(H x W\) as .*b/00000000\.png, got 32 x 50"
    ):
        clips[1]
    write_film(tmp_path / "b", 3)
    train = SequenceClips(found(tmp_path / "b").test, ClipRecipe(scale=2), patch=18)
    with pytest.raises(VideoError, match=r"patch: expected at most 16, as .* gives 16 x 24 sensor pixels at scale 2"):
        train[0]
    with pytest.raises(VideoError, match="b: frames: expected 34 x 34 pixels or more, got 32 x 48"):
        SequenceClips(train.places[0][:1], ClipRecipe(scale=17))[0]

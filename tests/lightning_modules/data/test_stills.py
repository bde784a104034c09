"""Clips of still pictures: seed and index determine them; new ones in every epoch; pictures of any folder."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from skimage import io

from lightning_modules.data.pictures import embedded_pictures, folder_pictures, split_pictures
from lightning_modules.data.stills import StillClips, StillScenes
from lightning_modules.data.textures import outline_mask, texture
from spikekit import SensorNoise, bin_to_sensor

SMALL = {"patch": 8, "val_patch": 8, "train_clips": 8, "val_clips": 4, "batch_size": 2}
NEEDS_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")


def scenes(**options):
    data = StillScenes(**{**SMALL, "workers": 0, **options})
    data.setup("fit")
    return data


def digest(clip):
    return hashlib.sha256(b"".join(clip[name].numpy().tobytes() for name in sorted(clip))).hexdigest()


def clips_of(loader):
    return [digest({name: value[i] for name, value in batch.items()}) for batch in loader for i in range(2)]


@pytest.fixture
def folder(tmp_path):
    """Pictures of every kind, in a folder, in those inside it and in one that is linked; one hidden, and a text."""
    rng = np.random.default_rng(0)
    (tmp_path / "inside" / "deep").mkdir(parents=True)
    (tmp_path / ".hidden").mkdir()
    io.imsave(tmp_path / "colour.png", rng.integers(0, 256, (40, 50, 3), "uint8"), check_contrast=False)
    io.imsave(tmp_path / "grey.JPG", rng.integers(0, 256, (90, 60), "uint8"), check_contrast=False)
    io.imsave(tmp_path / "rgba.png", rng.integers(0, 256, (33, 64, 4), "uint8"), check_contrast=False)
    io.imsave(tmp_path / "inside" / "deep.png", rng.integers(0, 2**16, (50, 50), "uint16"), check_contrast=False)
    io.imsave(tmp_path / "inside" / "deep" / "tiny.tif", rng.integers(0, 256, (3, 2, 3), "uint8"), check_contrast=False)
    io.imsave(tmp_path / ".hidden" / "not.png", rng.integers(0, 256, (9, 9), "uint8"), check_contrast=False)
    (tmp_path / "notes.txt").write_text("no picture")
    (tmp_path / "inside" / "back").symlink_to(tmp_path)
    (tmp_path.parent / "linked").mkdir(exist_ok=True)
    io.imsave(tmp_path.parent / "linked" / "far.png", rng.integers(0, 256, (20, 20), "uint8"), check_contrast=False)
    (tmp_path / "link").symlink_to(tmp_path.parent / "linked")
    return tmp_path


def test_clip_matches_its_scene():
    data = scenes(patch=12, flow_times=(5, 35, 20), alpha=0.7, pattern="GBRG")
    scene, clip = data.train_set.scene(3), data.train_set[3]
    assert {name: (value.shape, value.dtype) for name, value in clip.items()} == {
        "spikes": ((41, 12, 12), torch.uint8),
        "rgb": ((3, 48, 48), torch.float32),
        "flow": ((3, 2, 12, 12), torch.float32),
    }
    assert 0 <= clip["rgb"].min() < clip["rgb"].max() <= 1
    assert torch.equal(clip["rgb"], scene.rgb(20))
    assert torch.equal(clip["flow"], torch.stack([scene.flow(t, scale=4) for t in (5, 35, 20)]))
    assert not clip["flow"][2].any()
    light = torch.stack([bin_to_sensor(scene.rgb(t), "GBRG", scale=4) for t in range(41)]).sum(0) * 0.7
    assert (clip["spikes"].float().sum(0) - light).abs().max() < 1.001


@pytest.mark.parametrize("key_frames", [1, 3])
def test_spikes_include_the_margin_with_and_without_cache(tmp_path, monkeypatch, key_frames):
    options = {"scale": 2, "key_frames": key_frames, "every": 20}
    data, cached = (scenes(patch=6, flow_patch=12, cache=cache, **options) for cache in (None, str(tmp_path)))
    assert data.val_set[0]["spikes"].shape[-2:] == (8, 8)
    wide = scenes(patch=14, **options).train_set[3]
    flow = {"flow": wide["flow"][..., 4:10, 4:10]} if key_frames == 1 else {"every": torch.tensor(20)}
    expected = {"spikes": wide["spikes"], "rgb": wide["rgb"][..., 8:20, 8:20], **flow}  # 4 more on every side
    cached.train_set[3]
    clip = data.train_set[3]
    monkeypatch.setattr(StillClips, "whole", lambda self, index: pytest.fail("made again"))
    kept = cached.train_set[3]
    assert clip.keys() == kept.keys() == expected.keys()
    for name, value in expected.items():
        assert torch.equal(clip[name], value)
        torch.testing.assert_close(kept[name], value, rtol=1e-3, atol=1e-3 if name == "flow" else 0)
    for other in ({"alpha": 0.5}, {"flow_patch": 6}, {"seed": 1}, {"noise": SensorNoise()}):
        with pytest.raises(pytest.fail.Exception, match="made again"):
            scenes(**{"patch": 6, "flow_patch": 12, "cache": str(tmp_path), **options, **other}).train_set[3]


@pytest.mark.filterwarnings("ignore:This DataLoader will create")
def test_clips_do_not_depend_on_workers_or_default_device():
    alone, data = scenes(), scenes(workers=2)
    expected = clips_of(alone.train_dataloader())
    assert expected[::-1] == [digest(alone.train_set[i]) for i in range(7, -1, -1)]
    assert len(set(expected)) == 8
    loader = data.train_dataloader()
    assert loader.num_workers == 2
    for device in ("cpu", "meta"):  # workers stay, the second round starts anew
        with torch.device(device):
            assert clips_of(loader) == expected
            assert clips_of(data.val_dataloader()) == clips_of(alone.val_dataloader())


def test_clips_do_not_depend_on_global_random_state():
    torch.manual_seed(1)
    np.random.seed(1)  # noqa: NPY002
    first = digest(scenes().train_set[0])
    torch.manual_seed(2)
    assert digest(scenes().train_set[0]) == first
    assert torch.initial_seed() == 2
    assert digest(scenes(seed=1).train_set[0]) != first
    assert digest(scenes().val_set[0]) != first


@pytest.mark.parametrize("kind", ["motion", "bend"])
def test_motion_stays_within_its_bounds(kind):
    clips = scenes(**{"motion": 0.0, kind: 2.0}, rotation=0.0, zoom=0.0, objects=0).train_set
    first, last = (torch.stack([clips.scene(i).flow(t, scale=4)[:, 0, 0] for i in range(30)]) for t in (0, 40))
    torch.testing.assert_close(first, last if kind == "bend" else -last)  # acceleration adds the same at both ends
    assert 1.2 < last.norm(dim=1).max() <= 2.0 + 1e-5
    assert (last.amin(0) < -0.8).all()
    assert (last.amax(0) > 0.8).all()
    assert not scenes(motion=0.0, rotation=0.0, zoom=0.0).train_set[1]["flow"].any()


def test_options_change_the_scene():
    assert {len(scenes(objects=3).train_set.scene(i).layers) for i in range(40)} == {1, 2, 3, 4}
    dark, bright = (scenes(brightness=(b, b)).train_set[4] for b in (0.5, 1.0))
    torch.testing.assert_close(dark["rgb"] * 2, bright["rgb"])
    assert abs(dark["spikes"].float().mean() * 2 - bright["spikes"].float().mean()) < 0.02
    clean, noisy = (scenes(noise=noise).val_set[4] for noise in (None, SensorNoise(photons=10.0)))
    assert torch.equal(clean["rgb"], noisy["rgb"])
    assert not torch.equal(clean["spikes"], noisy["spikes"])
    turned = scenes(motion=0.0, rotation=5.0, zoom=0.0, objects=0)
    assert turned.train_set[0]["flow"][0, :, 0, 0].norm() > 0
    assert scenes(frames=11, flow_times=(0, 10)).train_set[0]["spikes"].shape[0] == 11


def test_training_covers_all_noise_levels():
    """Dark current in the dark: at most 0.2 spikes per clock, on average 0.067, as a third have none."""
    noise, dark = SensorNoise(dark_current=0.2, dead=0.004, hot=0.004), {"brightness": (1e-6, 1e-6), "patch": 32}
    clips = scenes(noise=noise, val_patch=32, **dark).train_set
    rates = torch.tensor([clips[n]["spikes"].double().mean() for n in range(24)])
    assert rates.min() < 0.01 < 0.15 < rates.max() < 0.21
    assert 0.03 < rates.mean() < 0.11
    shown = StillClips(embedded_pictures(), scale=2, augment=False, noise=noise, **dark)[0]["spikes"].double()
    assert 0.18 < shown.mean(0).min() < shown.mean(0).max() < 0.22  # defects are filled


def test_key_frames_show_one_moving_scene():
    clips = StillClips(embedded_pictures(), scale=2, patch=16, key_frames=3, every=10, motion=2.0, bend=0.5, objects=1)
    clip, scene = clips[3], clips.scene(3)
    assert scene.frames == 61
    assert clip["spikes"].shape == (3, 41, 16, 16)
    assert clip["every"] == 10
    assert clip["spikes"][0, 10:].equal(clip["spikes"][1, :31])
    for n, rgb in enumerate(clip["rgb"]):
        assert rgb.equal(scene.rgb(20 + 10 * n))
    single = StillClips(embedded_pictures(), scale=2, patch=16, motion=2.0, bend=0.5, objects=1).scene(3)
    assert (single.layers[0].motion.velocity == scene.layers[0].motion.velocity).all()  # as fast as in a single clip


@pytest.mark.parametrize("options", [{}, {"pattern": "grey", "key_frames": 2}, {"gains": (0.05, 1.0), "scale": 3}])
@pytest.mark.parametrize("on", ["cpu", pytest.param("cuda", marks=NEEDS_GPU)])
def test_batches_equal_single_clips(on, options):
    noise = SensorNoise(gain_spread=0.05, dark_current=0.002, dark_spread=0.3, hot=0.001, dead=0.01)
    clips = StillClips(embedded_pictures(), **{"scale": 2, "patch": 16, "noise": noise, "textures": True} | options)
    drawn = [clips.draw(index) for index in range(3)]
    drawn = {name: np.stack([one[name] for one in drawn]) for name in drawn[0]}
    batch = {name: value.cpu() for name, value in clips.render(drawn, clips.sources.gallery(on)).items()}
    for index in range(3):
        alone = clips[index]
        spikes = clips.cut({"spikes": batch["spikes"][index]})["spikes"]
        assert (alone["spikes"] != spikes).double().mean() < (1e-3 if on == "cpu" else 5e-3)
        for name in batch.keys() - {"spikes"}:
            torch.testing.assert_close(batch[name][index], alone[name], atol=1e-4, rtol=0)
    assert 0.05 < batch["spikes"].float().mean() < 0.5


def test_embedded_pictures_are_disjoint():
    train, held_out = embedded_pictures(), embedded_pictures(held_out=True)
    assert len(train) >= 8
    assert len(held_out) == 4
    assert not set(train) & set(held_out)
    data = scenes()
    assert (data.train_set.pictures, data.val_set.pictures) == (train, held_out)


def test_pictures_of_any_folder(folder):
    names = ["colour.png", "grey.JPG", "tiny.tif", "deep.png", "far.png", "rgba.png"]
    assert [path.name for path in folder_pictures(folder)] == names
    data = scenes(root=str(folder), val_root=str(folder), patch=12, val_patch=12)
    for clips in (data.train_set, data.val_set):
        for i in range(6):
            rgb = clips[i]["rgb"]
            assert rgb.shape == (3, 48, 48)
            assert rgb.isfinite().all()
            assert rgb.amax() > 0
    assert [int(data.val_set.draw(i)["picture"][0]) for i in range(8)] == [0, 1, 2, 3, 4, 5, 0, 1]


def test_folder_without_validation_is_split(folder):
    data = scenes(root=str(folder))
    train, val = set(data.train_set.pictures), set(data.val_set.pictures)
    assert train | val == set(folder_pictures(folder))
    assert not train & val
    assert scenes(root=str(folder)).val_set.pictures == data.val_set.pictures
    many = [Path(f"{i}.png") for i in range(400)]
    stay, out = split_pictures(many, 3)
    assert (len(stay), len(out)) == (380, 20)
    assert [len(part) for part in split_pictures(many[:10], 0)] == [6, 4]
    assert [len(part) for part in split_pictures(many[:2], 0)] == [1, 1]
    assert split_pictures(many[:1], 0) == (many[:1], many[:1])


def test_errors_name_the_argument(folder, tmp_path):
    (tmp_path / "empty").mkdir()
    for name, value, message in (
        ("root", "nowhere", "nowhere: no such folder"),
        ("val_root", "nowhere", "nowhere: no such folder"),
        ("val_root", "empty", "no picture in this folder"),
        ("root", "notes.txt", "expected a folder of pictures, got a file"),
    ):
        with pytest.raises(OSError, match=message):
            scenes(**{name: str(tmp_path / value)})
    for name, value, message in (
        ("brightness", (0.9, 0.5), "brightness: expected two numbers"),
        ("gains", (0.0, 1.0), "gains: expected two numbers"),
        ("flow_times", (5, 41), r"flow_times: expected clocks in \[0, 41\), got \(5, 41\)"),
        ("batch_size", 9, "train_clips: expected at least batch_size"),
        ("batch_size", 0, "batch_size: expected a whole number >= 1, got 0"),
        ("val_clips", 0, "val_clips: expected a whole number >= 1, got 0"),
    ):
        with pytest.raises(ValueError, match=message):
            scenes(**{name: value})


def test_corrupt_picture_is_named(tmp_path):
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\nnot really")
    data = scenes(root=str(tmp_path), workers=1)
    with pytest.raises(ValueError, match=r"broken\.png: not a readable picture"):
        next(iter(data.train_dataloader()))


def test_outlines_and_textures_are_valid():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        mask = outline_mask(31, rng)
        assert 0.08 < mask.mean() < 0.9
        assert ((mask > 0) & (mask < 1)).float().mean() < 0.2  # an edge, no feathers
        assert mask[15, 15] == 1
        picture = texture(40, 50, rng)
        assert picture.shape == (3, 40, 50)
        assert 0 <= picture.min() < picture.max() <= 1


def test_grey_clips_are_the_luminance_of_the_same_scenes():
    options = {"scale": 2, "patch": 12, "motion": 2.0}
    pictures = embedded_pictures()[:2]
    grey, colour = (StillClips(pictures, pattern=pattern, **options) for pattern in ("grey", "RGGB"))
    clip = grey[3]
    assert clip["spikes"].shape == (41, 12, 12)
    assert clip["rgb"].shape == (1, 24, 24)
    assert torch.equal(clip["flow"], colour[3]["flow"])
    luminance = bin_to_sensor(colour[3]["rgb"], "grey", scale=1)
    torch.testing.assert_close(clip["rgb"][0], luminance, rtol=1e-4, atol=1e-5)


def test_training_clips_include_gain_and_noise():
    options = {"patch": 12, "scale": 1, "noise": SensorNoise(photons=1000), "gains": (0.03, 1.0)}
    clips = StillClips(embedded_pictures()[:2], **options, length=200)
    gains, noise = (torch.tensor([clips.draw(n)[name].item() for n in range(60)]) for name in ("alpha", "noise"))
    assert gains.min() >= 0.03
    assert gains.max() <= 1
    assert 0.25 < ((gains < 0.17).float().mean()) < 0.75  # half of them below the geometric mean
    for n in range(3):
        light = clips.scene(n).light(scale=1, alpha=clips[n]["alpha"].item())
        assert abs(clips[n]["spikes"].float().mean() - light.clamp(max=1).mean()) < 0.05
    assert 0.2 < (noise == 0).float().mean() < 0.5 < noise.max() <= 1
    fixed = StillClips(embedded_pictures()[:2], **options, augment=False)
    assert fixed[0]["alpha"] == torch.tensor(fixed.alpha)
    assert fixed[0]["noise"] == 1
    assert StillClips(embedded_pictures()[:2], patch=12)[0].keys() == {"spikes", "rgb", "flow"}

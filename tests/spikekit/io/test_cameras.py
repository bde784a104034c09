"""Camera presets and their application in the right order."""

import json

import pytest
import torch

from spikekit.color.cfa import PATTERNS, bayer_mask, mosaic
from spikekit.io.cameras import CAMERAS, Camera, camera

PLAIN = {
    "title": "a camera",
    "height": 6,
    "width": 8,
    "drop": [],
    "rate": 1000,
    "flip": False,
    "pattern": None,
    "crop": [0, 0, 0, 0],
    "gain": 1.0,
    "gamma": 1.0,
    "source": "invented",
}


def stored(tmp_path, **changes):
    path = tmp_path / "own.json"
    path.write_text(json.dumps(PLAIN | changes))
    return path


def test_cameras_of_the_package_are_described_fully():
    known = {name: camera(name) for name in CAMERAS}
    assert {name for name, c in known.items() if c.flip} == {"m1k40", "m1k40-bayer", "vidar"}
    assert all(c.source and c.title and c.rate == 20_000 for c in known.values())
    colour = known.pop("m1k40-bayer")
    assert (colour.pattern, colour.prepared_pattern, colour.prepared_size) == ("BGGR", "RGGB", (992, 992))
    for grey in known.values():
        assert (grey.pattern, grey.prepared_pattern) == (None, None)
        assert grey.prepared_size == (grey.height, grey.width)
        picture = torch.rand(4, 5)
        assert torch.equal(grey.display(picture), picture)


@pytest.mark.parametrize("name", CAMERAS)
def test_stored_frames_are_prepared(name):
    """Number the pixels, store them like the camera, and recover them."""
    known = camera(name)
    seen = torch.arange(known.height * known.width).reshape(1, known.height, known.width)
    top, bottom, left, right = known.crop
    expected = seen[:, top : known.height - bottom, left : known.width - right]
    frames = seen.flip(-2) if known.flip else seen
    assert torch.equal(known.prepare(frames), expected)
    assert torch.equal(known.prepare(seen, flip=False), expected)
    assert torch.equal(known.prepare(seen.flip(-2), flip=True), expected)
    raw = torch.full((1, known.height, known.stored_width), -1)
    pixels = torch.ones(known.stored_width, dtype=torch.bool)
    for start, stop in {"vidar": [(400, 416)], "uhsr": []}.get(name, [(500, 512), (1000, 1012)]):
        pixels[start:stop] = False
    raw[..., pixels] = frames
    assert torch.equal(known.prepare(raw), expected)
    assert expected.shape[-2:] == known.prepared_size


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("crop", [(1, 0, 0, 2), (0, 1, 3, 0), (1, 1, 1, 1)])
def test_the_crop_shifts_the_bayer_phase(tmp_path, pattern, crop):
    own = camera(stored(tmp_path, pattern=pattern, crop=crop))
    colours = torch.tensor([1.0, 2.0, 3.0])[:, None, None]
    height, width = own.prepared_size
    expected = (bayer_mask(height, width, own.prepared_pattern) * colours).sum(0)
    assert torch.equal(own.prepare(mosaic(colours.expand(3, 6, 8), pattern)), expected)


def test_pictures_are_shown_with_gain_and_gamma():
    picture = torch.tensor([[-0.1, 0.0, 0.24, 0.5, 0.9]])
    shown = camera("m1k40-bayer").display(picture)
    torch.testing.assert_close(shown, torch.tensor([[0.0, 0.0, 0.6, 0.75**0.5, 1.0]]))
    assert camera("m1k40-bayer").display(picture.double()).dtype == torch.float64


def test_camera_from_a_json_file(tmp_path):
    own = camera(stored(tmp_path, drop=[[0, 2], [5, 6]], crop=[1, 2, 0, 3]))
    assert own == Camera(**{**PLAIN, "name": "own", "drop": ((0, 2), (5, 6)), "crop": (1, 2, 0, 3)})
    raw = torch.arange(11).expand(6, 11)
    assert own.prepare(raw)[0].tolist() == [2, 3, 4, 6, 7]
    assert own.prepare(raw).shape == (3, 5)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"height": 0}, "height: expected a whole number >= 1, got 0"),
        ({"flip": 1}, "flip: expected bool, got 1"),
        ({"pattern": "RGBG"}, "RGBG"),
        ({"crop": [3, 3, 0, 0]}, "crop: expected \\[top, bottom, left, right\\] that leaves pixels"),
        ({"drop": [[4, 2]]}, "drop: expected"),
        ({"colour": "red"}, "got title, .*, colour"),
        ([1], "expected an object with title, height, .*, got list"),
        ('{"title": "a', "line 1"),
    ],
)
def test_invalid_camera_files_are_rejected(tmp_path, given, message):
    path = tmp_path / "own.json"
    path.write_text(
        given if isinstance(given, str) else json.dumps(PLAIN | given if isinstance(given, dict) else given)
    )
    with pytest.raises(ValueError, match=message) as raised:
        camera(path)
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)


def test_errors_say_what_was_expected(tmp_path):
    for name, said in (
        ("leica", "camera: expected m1k40, m1k40-bayer, uhsr, vidar, or a .json file, got leica"),
        (tmp_path / "none.json", r"none.json: .*No such file"),
    ):
        with pytest.raises(ValueError, match=said):
            camera(name)
    for name, width, said in (("vidar", 250, "250 x 400 or 416"), ("uhsr", 400, "250 x 250")):
        with pytest.raises(ValueError, match=f"spikes: expected {said} for the camera {name}, got 250 x {width}"):
            camera(name).prepare(torch.zeros(3, 250, width))

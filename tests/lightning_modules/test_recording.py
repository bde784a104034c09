import pytest
import torch

from lightning_modules.cli import main
from lightning_modules.data import Recording, RecordingClips
from spikekit import SpikeFileError, bayer_mask, mosaic, read_picture, simulate_spikes, split_bayer, write_spikes

PATTERNS = ["RGGB", "BGGR", "GRBG", "GBRG"]


@pytest.fixture
def spikes():
    return (torch.rand(70, 6, 10) < 0.3).to(torch.uint8)


@pytest.mark.parametrize("name", ["clip.dat", "clip.npz"])
def test_clips_are_those_of_the_file(tmp_path, spikes, name):
    write_spikes(tmp_path / name, spikes)
    data = Recording(str(tmp_path / name), 6, 10, every=10)
    data.setup("predict")
    batches = list(data.predict_dataloader())
    assert [batch["frame"].item() for batch in batches] == [20, 30, 40]
    for batch in batches:
        frame = batch["frame"].item()
        assert batch["spikes"].equal(spikes[None, frame - 20 : frame + 21])


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("flip", [False, True])
def test_every_phase_becomes_rggb(tmp_path, spikes, pattern, flip):
    write_spikes(tmp_path / "clip.dat", spikes, flip=flip)
    (clip,) = RecordingClips(str(tmp_path / "clip.dat"), 6, 10, flip, pattern, every=60)
    red = split_bayer(spikes, pattern)[0][:41]
    found = clip["spikes"][:, ::2, ::2]
    assert found.equal(red[:, : found.shape[1], : found.shape[2]])


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("crop_to", PATTERNS)
def test_every_phase_becomes_that_of_the_network(tmp_path, pattern, crop_to):
    red = bayer_mask(6, 10, pattern, dtype=torch.uint8)[0]
    write_spikes(tmp_path / "red.npz", red.expand(41, 6, 10))
    (clip,) = RecordingClips(str(tmp_path / "red.npz"), pattern=pattern, crop_to=crop_to)
    height, width = clip["spikes"].shape[-2:]
    assert {6 - height, 10 - width} <= {0, 1}
    assert clip["spikes"].equal(bayer_mask(height, width, crop_to, dtype=torch.uint8)[0].expand(41, -1, -1))


@pytest.mark.parametrize("trained", ["RGGB", "GBRG"])
def test_predict_gives_the_colours_of_the_scene_whatever_phase_the_network_wants(tmp_path, monkeypatch, trained):
    colour = torch.tensor([0.9, 0.3, 0.1])
    light = 0.4 * mosaic(colour[:, None, None].expand(41, 3, 16, 20), "BGGR")
    write_spikes(tmp_path / "flat.npz", simulate_spikes(light, generator=torch.Generator().manual_seed(0)))
    network = ["--model.network", "ClassicalDecoder", "--model.network.scale", "2", "--model.network.pattern", trained]
    data = ["--data", "Recording", "--data.path", str(tmp_path / "flat.npz"), "--data.pattern", "BGGR"]
    monkeypatch.setattr("sys.argv", ["lightning", "predict", *network, *data, "-o", str(tmp_path / "out")])
    main()
    (path,) = (tmp_path / "out").rglob("*.png")
    torch.testing.assert_close(read_picture(path).mean(dim=(1, 2)), colour, rtol=0, atol=0.04)


def test_a_recording_of_which_too_little_is_left_is_refused(tmp_path):
    write_spikes(tmp_path / "tiny.npz", torch.zeros(41, 3, 5, dtype=torch.uint8))
    RecordingClips(str(tmp_path / "tiny.npz"))
    with pytest.raises(
        ValueError, match=r"tiny.npz: expected at least 3 x 3 pixels that begin with RGGB, got \(2, 4\)"
    ):
        RecordingClips(str(tmp_path / "tiny.npz"), pattern="BGGR")


def test_errors(tmp_path, spikes):
    path = tmp_path / "clip.dat"
    write_spikes(path, spikes[:40])
    with pytest.raises(ValueError, match=r"clip\.dat: expected at least 41 frames for a clip, got 40"):
        RecordingClips(str(path), 6, 10)
    with pytest.raises(SpikeFileError, match=r"none\.dat"):
        RecordingClips(str(tmp_path / "none.dat"), 6, 10)
    with pytest.raises(ValueError, match="every"):
        RecordingClips(str(path), 6, 10, every=0)

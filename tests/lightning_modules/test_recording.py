import pytest
import torch

from lightning_modules.data import Recording, RecordingClips
from spikekit import SpikeFileError, split_bayer, write_spikes


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


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
@pytest.mark.parametrize("flip", [False, True])
def test_every_phase_becomes_rggb(tmp_path, spikes, pattern, flip):
    write_spikes(tmp_path / "clip.dat", spikes, flip=flip)
    (clip,) = RecordingClips(str(tmp_path / "clip.dat"), 6, 10, flip, pattern, every=60)
    red = split_bayer(spikes, pattern)[0][:41]
    found = clip["spikes"][:, ::2, ::2]
    assert found.equal(red[:, : found.shape[1], : found.shape[2]])


def test_errors(tmp_path, spikes):
    path = tmp_path / "clip.dat"
    write_spikes(path, spikes[:40])
    with pytest.raises(ValueError, match=r"clip\.dat: expected at least 41 frames for a clip, got 40"):
        RecordingClips(str(path), 6, 10)
    with pytest.raises(SpikeFileError, match=r"none\.dat"):
        RecordingClips(str(tmp_path / "none.dat"), 6, 10)
    with pytest.raises(ValueError, match="every"):
        RecordingClips(str(path), 6, 10, every=0)

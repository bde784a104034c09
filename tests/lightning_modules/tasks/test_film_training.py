"""Training and test on several key frames of a scene."""

import csv

import pytest
import torch

from lightning_modules.__main__ import main
from lightning_modules.networks import CSCSR, ClassicalDecoder, RecurrentCSCSR
from lightning_modules.storage.pretrained import Weights, read_weights, settings_of, write_weights
from lightning_modules.tasks.super_resolution import SuperResolution
from spikekit import psnr

TINY = {"scale": 2, "width": 8, "representation_width": 8, "features": 1, "stages": 1, "end_blocks": 1}
SIZES = {"key_frames": 5, "every": 10, "patch": 16, "val_patch": 16, "train_clips": 4, "batch_size": 2, "val_clips": 2}
DATA = [*(f"--data.{name}={value}" for name, value in SIZES.items()), "--data.workers=0", "--trainer.accelerator=cpu"]


@pytest.fixture(name="trained", scope="module")
def _trained(tmp_path_factory):
    """The weights that a training of four steps began with, and what it made of them."""
    folder = tmp_path_factory.mktemp("film")
    torch.manual_seed(0)
    network = RecurrentCSCSR(**TINY)
    write_weights(Weights(folder, settings_of(network), {}, network.state_dict()), folder / "start.safetensors")
    words = ["-c", "x2", "--data=StillScenes", *DATA]
    model = ["--model.flow=estimated", "--model.future=4", "--model.frozen=[representation,refinement,reconstruction]"]
    start = ["--model.weights", str(folder / "start.safetensors"), "--trainer.max_steps=4"]
    main(["fit", *words, *model, *start, "-o", str(folder / "run")])
    return words, folder


def test_only_unfrozen_parts_are_trained(trained):
    _, folder = trained
    before = read_weights(folder / "start.safetensors").tensors
    after = read_weights(folder / "run" / "checkpoints" / "last.ckpt").tensors
    changed = {name for name in before if not before[name].equal(after[name])}
    assert changed == {name for name in before if name.startswith("fusion.")}


def test_films_are_compared_with_single_clips(trained):
    words, folder = trained
    last = str(folder / "run" / "checkpoints" / "last.ckpt")
    main(["test", *words, "--model.weights", last, "--model.future=4", "-o", str(folder / "test")])
    with open(folder / "test" / "test.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["clip"] == "mean"]
    assert [row["method"] for row in rows] == ["TFI", "TFP", "RecurrentCSCSR, single clips", "RecurrentCSCSR, film"]
    assert rows[2]["psnr"] != rows[3]["psnr"]


def batch(count=5):
    spikes = (torch.rand(2, count, 41, 12, 12) < 0.3).to(torch.uint8)
    return {"spikes": spikes, "rgb": torch.rand(2, count, 3, 24, 24), "every": torch.full((2,), 20)}


def test_loss_covers_both_passes_over_a_film():
    module = SuperResolution(RecurrentCSCSR(**TINY), flow="estimated", future=4)
    for weight in module.network.fusion.parameters():
        torch.nn.init.normal_(weight, std=0.05)
    module.log = lambda *_, **__: None
    clips = batch()
    read = module.network.film(clips["spikes"], future=4)
    expected = sum((rgb - clips["rgb"]).abs().mean() for rgb in read) / 2
    torch.testing.assert_close(module.training_step(clips, 0), expected)
    assert not torch.allclose(read[0], read[1])


def test_network_without_state_takes_single_key_frames():
    module = SuperResolution(CSCSR(**TINY), flow="estimated").eval()
    module.log = lambda *_, **__: None
    clips = batch(count=3)
    shown = module.validation_step(clips, 0)
    torch.testing.assert_close(shown, module(clips["spikes"][:, 1]))
    tested = module.test_step(clips, 0)
    assert tested["pictures"].keys() == tested["scores"].keys() == {"TFI", "TFP", "CSCSR, single clips"}
    shown = psnr(module(clips["spikes"].flatten(0, 1)), clips["rgb"].flatten(0, 1)).reshape(-1, 3)[:, 0:3]
    torch.testing.assert_close(tested["scores"]["CSCSR, single clips"]["psnr"], shown.mean(dim=1))


def test_invalid_arguments_are_rejected():
    with pytest.raises(ValueError, match="future: expected 0, as ClassicalDecoder takes single clips, got 2"):
        SuperResolution(ClassicalDecoder(), future=2)
    with pytest.raises(ValueError, match=r"frozen: expected parts of the network, such as motion, .* got nothing"):
        SuperResolution(RecurrentCSCSR(**TINY), frozen=["nothing"])

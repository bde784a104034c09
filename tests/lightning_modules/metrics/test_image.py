"""LPIPS, with a stand-in for torchvision: AlexNet's layers with random weights."""

import re
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace

import pytest
import torch
from torch import nn

from lightning_modules.__main__ import main
from lightning_modules.metrics import image as quality
from spikekit import psnr, ssim


def alexnet(weights):
    """As torchvision's: the layers of Krizhevsky's, One weird trick, 2014."""
    assert weights == "all"
    made = []
    for inputs, outputs, side, stride, padding in (
        (3, 64, 11, 4, 2), (64, 192, 5, 1, 2), (192, 384, 3, 1, 1), (384, 256, 3, 1, 1), (256, 256, 3, 1, 1)
    ):  # fmt: skip
        made += [nn.Conv2d(inputs, outputs, side, stride, padding), nn.ReLU()]
        if inputs in (3, 64):
            made.append(nn.MaxPool2d(3, 2))
    return SimpleNamespace(features=nn.Sequential(*made))


@pytest.fixture
def torchvision(monkeypatch, tmp_path):
    pytest.importorskip("torchmetrics.image.lpip")  # before it can see a torchvision that is none
    models = SimpleNamespace(alexnet=alexnet, AlexNet_Weights=SimpleNamespace(DEFAULT="all"))
    module = ModuleType("torchvision")
    module.models, module.__spec__ = models, ModuleSpec("torchvision", None)
    monkeypatch.setitem(sys.modules, "torchvision", module)
    monkeypatch.setattr("torchmetrics.image.lpip._TORCHVISION_AVAILABLE", True)
    monkeypatch.setattr("torchmetrics.functional.image.lpips._TORCHVISION_AVAILABLE", True)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    file = tmp_path / "hub" / "checkpoints" / "alexnet-owt-7be5be79.pth"
    file.parent.mkdir(parents=True)
    file.touch()
    quality._metric.cache_clear()
    yield file
    quality._metric.cache_clear()


def test_lpips_of_every_picture(torchvision):
    truth = torch.rand(3, 3, 70, 64, generator=torch.Generator().manual_seed(0))
    rgb = truth.clone()
    rgb[1] += 0.1 * torch.randn(3, 70, 64, generator=torch.Generator().manual_seed(1))
    rgb[2] = 0.5
    assert quality.why_no_lpips() is None
    name, heading, digits, of = quality.measures()[-1]
    assert (name, heading, digits) == ("lpips", "LPIPS", 4)
    same, noisy, flat = of(rgb, truth).tolist()
    assert same == 0 < noisy < flat
    assert of(2 * truth, truth.clamp(max=1)).tolist() == of((2 * truth).clamp(max=1), truth).tolist()
    assert of(rgb[:1].double(), truth[:1].double()).item() == 0
    assert of(rgb[..., :62, :], truth[..., :62, :]).isnan().all()
    # as the authors give it pictures: 0 .. 1, not brought to -1 .. 1
    as_learned = quality._metric(rgb.device)(2 * rgb[2:] - 1, 2 * truth[2:] - 1)
    assert abs(as_learned.item() - flat) > 0.01 * flat


def test_what_lpips_lacks(torchvision, monkeypatch):
    torchvision.unlink()
    assert f"weights of AlexNet in {torchvision}, got none" in quality.why_no_lpips()
    monkeypatch.delitem(sys.modules, "torchvision")
    monkeypatch.setattr(quality, "find_spec", lambda name: None)
    assert quality.why_no_lpips() == "LPIPS not measured: expected torchvision, which is not installed"
    assert [measure.of for measure in quality.measures()] == [psnr, ssim]


@pytest.mark.parametrize("there", [True, False])
def test_the_tables_say_lpips_or_why_not(torchvision, there, configs, tmp_path, capsys):
    if not there:
        torchvision.unlink()
    shared = ["-c", str(configs / "x2.yaml"), "--data.val_clips", "2", "--data.val_patch", "32", "-o", str(tmp_path)]
    decoder = ["--model.network", "ClassicalDecoder", "--model.network.method", "tfi"]
    main(["test", *shared, *decoder])
    printed = capsys.readouterr().out
    assert ("LPIPS not measured: expected the weights" in printed) != there
    assert bool(re.search(r"SSIM +\| LPIPS", printed)) == there
    header, *rows = (line.split(",") for line in (tmp_path / "test.csv").read_text().splitlines())
    assert header[2:] == ["psnr", "ssim", *["lpips"] * there]
    assert all(0 < float(row[-1]) < 1 for row in rows)
    main(["trade", *shared, "--rounds", "1", "--setting", f"TFI: {' '.join(decoder)}"])
    table = (tmp_path / "trade.md").read_text()
    assert bool(re.search(r"\| LPIPS +\|", table)) == there
    assert ("LPIPS not measured: expected the weights" in table) != there

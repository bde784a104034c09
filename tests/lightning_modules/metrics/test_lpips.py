"""LPIPS, with random weights, and with the true ones if they are installed."""

import os
import re

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file

from lightning_modules.__main__ import main
from lightning_modules.metrics.image import measures, why_no_lpips
from lightning_modules.metrics.lpips import VARIABLE, find_weights, lpips
from spikekit import read_picture

SHAPES = (64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    generator, tensors = torch.Generator().manual_seed(0), {}
    for n, (outputs, inputs, side) in enumerate(SHAPES):
        scale = (2 / (inputs * side * side)) ** 0.5
        tensors[f"conv{n}.weight"] = scale * torch.randn(outputs, inputs, side, side, generator=generator)
        tensors[f"conv{n}.bias"] = 0.1 * torch.randn(outputs, generator=generator)
        tensors[f"lin{n}.weight"] = torch.rand(1, outputs, 1, 1, generator=generator)
    path = tmp_path_factory.mktemp("lpips") / "lpips.safetensors"
    save_file(tensors, path)
    return path, tensors


def pictures(side=70):
    generator = torch.Generator().manual_seed(1)
    return torch.rand(2, 3, 3, side, 64, generator=generator).unbind()


def test_example_of_the_authors():
    path = os.environ.get(VARIABLE)
    folder = os.path.dirname(path or "")
    if not path or not os.path.isfile(f"{folder}/ex_ref.png"):
        pytest.skip(f"{VARIABLE} names no file of weights with the authors' example beside it")
    truth, first, second = (read_picture(f"{folder}/ex_{name}.png")[None] for name in ("ref", "p0", "p1"))
    assert lpips(first, truth).item() == pytest.approx(0.722, abs=2e-3)
    assert lpips(second, truth).item() == pytest.approx(0.138, abs=2e-3)


def test_distance_against_a_plain_implementation(weights):
    path, tensors = weights
    rgb, truth = pictures()
    expected = torch.zeros(3)
    features = [(2 * x - 1 - torch.tensor([-0.030, -0.088, -0.188]).view(3, 1, 1)) for x in (rgb, truth)]
    features = [x / torch.tensor([0.458, 0.448, 0.450]).view(3, 1, 1) for x in features]
    for n, (stride, padding) in enumerate([(4, 2), (1, 2), (1, 1), (1, 1), (1, 1)]):
        if n in (1, 2):
            features = [F.max_pool2d(x, 3, 2) for x in features]
        layer = tensors[f"conv{n}.weight"], tensors[f"conv{n}.bias"]
        features = [F.relu(F.conv2d(x, *layer, stride, padding)) for x in features]
        first, second = (F.normalize(x) for x in features)
        expected += ((first - second).square() * tensors[f"lin{n}.weight"]).sum(1).mean((1, 2))
    torch.testing.assert_close(lpips(rgb, truth, path), expected, rtol=1e-4, atol=1e-6)


def test_equal_bright_and_small_pictures(weights):
    path, _ = weights
    rgb, truth = pictures()
    assert lpips(truth, truth, path).tolist() == [0, 0, 0]
    assert lpips(2 * rgb, truth, path).equal(lpips((2 * rgb).clamp(max=1), truth, path))
    assert lpips(rgb[..., :31, :31], truth[..., :31, :31], path).isfinite().all()
    assert lpips(rgb[..., :30, :], truth[..., :30, :], path).isnan().all()
    assert lpips(rgb.double(), truth.double(), path).equal(lpips(rgb, truth, path))


def test_weights_of_torchvision_and_torchmetrics_are_found(weights, tmp_path, monkeypatch):
    pytest.importorskip("torchmetrics")
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    assert "LPIPS not measured" in why_no_lpips()
    assert [measure.name for measure in measures()] == ["psnr", "ssim"]
    path, tensors = weights
    features = {
        f"features.{n}.{part}": tensors[f"conv{layer}.{part}"]
        for layer, n in enumerate((0, 3, 6, 8, 10))
        for part in ("weight", "bias")
    }
    (tmp_path / "hub" / "checkpoints").mkdir(parents=True)
    torch.save(features, tmp_path / "hub" / "checkpoints" / "alexnet-owt-7be5be79.pth")
    assert [measure.name for measure in measures()] == ["psnr", "ssim", "lpips"]
    rgb, truth = pictures()
    assert (lpips(rgb, truth) > 0).all()
    assert not lpips(rgb, truth).equal(lpips(rgb, truth, path))  # other heads


def test_invalid_files_are_named(weights, tmp_path, monkeypatch):
    _, tensors = weights
    save_file({**tensors, "conv2.weight": torch.zeros(3)}, tmp_path / "a.safetensors")
    (tmp_path / "b.pth").write_bytes(b"no weights")
    for name in ("a.safetensors", "b.pth"):
        with pytest.raises(ValueError, match=rf"{name}: not the weights of LPIPS"):
            lpips(*pictures(), tmp_path / name)
    monkeypatch.setenv(VARIABLE, str(tmp_path / "nowhere"))
    with pytest.raises(FileNotFoundError, match="nowhere"):
        find_weights()


@pytest.mark.parametrize("there", [True, False])
def test_tables_show_lpips_or_the_reason_for_its_absence(weights, there, configs, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(weights[0]) if there else "")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "home"))
    shared = ["-c", str(configs / "x2.yaml"), "--data.val_clips", "2", "--data.val_patch", "32", "-o", str(tmp_path)]
    main(["test", *shared, "--model.network", "ClassicalDecoder", "--model.network.method", "tfi"])
    printed = capsys.readouterr().out
    assert ("LPIPS not measured: expected the weights" in printed) != there
    assert bool(re.search(r"SSIM +\| LPIPS", printed)) == there
    header, *rows = (line.split(",") for line in (tmp_path / "test.csv").read_text().splitlines())
    assert header[2:] == ["psnr", "ssim", *["lpips"] * there]
    assert len(rows) == 3 * len({row[0] for row in rows})

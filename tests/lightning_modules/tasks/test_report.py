"""The report of ``lightning test``: names, scores and pictures of clips."""

import csv
from types import SimpleNamespace

import pytest
import torch
from pytorch_lightning import Trainer

from lightning_modules.data import RecordingScenes, StillScenes
from lightning_modules.metrics.image import score
from lightning_modules.networks import CSCSR, ClassicalDecoder
from lightning_modules.tasks.callbacks import TestReport
from lightning_modules.tasks.super_resolution import SuperResolution
from spikekit import psnr, read_picture, simulate_spikes, write_spikes


def report_of(folder, clips, names):
    """Report of clips that a network scores n + 0.5 and TFI n, where n counts them."""
    report = TestReport(folder)
    report.on_test_start(None, None)
    columns = [column for column, _, _ in report.columns()]
    for n in range(clips):
        scores = {"CSCSR": torch.tensor([n + 0.5]), "TFI": torch.tensor([float(n)])}
        scores = {method: dict.fromkeys(columns, value) for method, value in scores.items()}
        pictures = {"TFI": torch.full((1, 3, 4, 4), n / 10)}
        report.on_test_batch_end(None, None, {"scores": scores, "pictures": pictures}, {"rgb": pictures["TFI"]})
    trainer = SimpleNamespace(datamodule=SimpleNamespace(test_names=names) if names else None)
    report.on_test_end(trainer, None)
    with open(folder / "test.csv", newline="") as file:
        return {(row["method"], row["clip"]): float(list(row.values())[2]) for row in csv.DictReader(file)}


def test_table_has_named_clips_and_their_mean(tmp_path, capsys):
    names = ["walk", "city"]  # with --trainer.limit_test_batches the first ones
    scores = report_of(tmp_path, 2, [*names, "foliage"])
    for method, more in (("CSCSR", 0.5), ("TFI", 0.0)):
        found = {clip: score for (of, clip), score in scores.items() if of == method}
        assert found == {"walk": more, "city": 1 + more, "mean": 0.5 + more}
    assert "mean of 2 clips" in capsys.readouterr().out


def test_number_of_pictures(tmp_path):
    report_of(tmp_path, 8, None)
    assert read_picture(tmp_path / "test.png")[0].unique().mul(10).round().tolist() in ([*range(6), 10], [*range(6)])


def test_scores_are_returned_to_python(tmp_path):
    data = StillScenes(scale=2, patch=8, val_patch=12, val_clips=2, workers=0)
    trainer = Trainer(logger=False, accelerator="cpu", enable_progress_bar=False, enable_model_summary=False)
    module = SuperResolution(CSCSR(2, width=4, representation_width=4, features=1, stages=1, end_blocks=1))
    [scores] = trainer.test(module, data, verbose=False)
    assert {"test/psnr", "test/ssim"} <= scores.keys()
    data.setup("test")
    clips = [data.test_set[n] for n in range(2)]
    with torch.no_grad():
        known = [psnr(module(clip["spikes"][None]), clip["rgb"][None]).item() for clip in clips]
    assert scores["test/psnr"] == pytest.approx(sum(known) / 2, abs=1e-4)


def test_blur_and_noise_without_ground_truth():
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
    sharp = (0.5 + 0.3 * torch.sign(torch.sin(x / 5) * torch.sin(y / 7))).expand(1, 3, -1, -1)
    noisy = sharp + 0.05 * torch.randn(1, 1, 64, 64, generator=torch.Generator().manual_seed(0))
    clean, blurred, noised = (score(rgb, None) for rgb in (sharp, torch.nn.functional.avg_pool2d(sharp, 5, 1), noisy))
    assert blurred["blur"] > clean["blur"] + 0.1
    assert (noised["noise"] - clean["noise"]).item() == pytest.approx(0.05, rel=0.15)


def test_recordings_are_measured_at_their_white_level(tmp_path):
    write_spikes(tmp_path / "a.npz", simulate_spikes(0.1 * (torch.arange(48) // 8 % 2) * torch.ones(81, 32, 1)))
    data = RecordingScenes(str(tmp_path / "a.npz"), pattern="grey", calibration="none")
    trainer = Trainer(logger=False, callbacks=[TestReport(tmp_path)], enable_progress_bar=False, accelerator="cpu")
    [scores] = trainer.test(SuperResolution(ClassicalDecoder("tfp", 1, "grey")), data, verbose=False)
    assert scores.keys() == {"test/blur", "test/noise"}
    shown = read_picture(tmp_path / "test.png")[:, :32, -48:]
    assert shown.mean().item() == pytest.approx(0.5, abs=0.1)  # half black, half white

"""Every file that lightning writes, on a full disk: an error that names it, what was there before, and nothing else."""

import warnings
from argparse import Namespace
from types import SimpleNamespace

import pytest
import torch
import yaml

from lightning_modules.__main__ import main
from lightning_modules.cli.command import Configuration
from lightning_modules.data.cache import ClipCache
from lightning_modules.inference import export
from lightning_modules.networks import ClassicalDecoder
from lightning_modules.storage.error_model import FILE, ErrorModel, write_error_model
from lightning_modules.storage.pretrained import Weights, write_weights
from lightning_modules.sweep import cli as sweep_cli
from lightning_modules.sweep import table as sweep_table
from lightning_modules.sweep.state import write_json
from lightning_modules.sweep.trials import Trial
from lightning_modules.tasks.callbacks import TestReport
from lightning_modules.tasks.checkpoint_io import Checkpoints
from lightning_modules.trade import table as trade_table
from lightning_modules.trade.measure import Measurement, Timed
from lightning_modules.trade.settings import read_setting
from spikekit import write_spikes

TRIAL = {
    "model": {"class_path": "SuperResolution", "init_args": {"network": {"init_args": {"width": 4}}}},
    "trainer": {"max_steps": 6},
}


def trials(path):
    return [Trial((str(n),), None, path.parent / f"trial{n}", TRIAL, {"steps": 6}) for n in range(500)]


def sweep_csv(path):
    sweep_table.write_csv(sweep_table.collect(trials(path), {}), path)


def sweep_md(path):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep_cli, "write_csv", lambda *_: None)
        sweep_cli._write_tables(trials(path), {}, Namespace(output=path.parent))


def trade_csv(path):
    runner = SimpleNamespace(network=torch.nn.Linear(2, 3))
    settings = [read_setting(f"{n}: --model.tile 8") for n in range(500)]
    rows = [Measurement(setting, runner, psnr=[20.0], ssim=[0.5], seconds=[1.0], macs=1.0) for setting in settings]
    trade_table.write_csv(rows, Timed(1, (8, 8), 2, "wall time"), path)


def configuration(path):
    parser = SimpleNamespace(dump=lambda *_, **__: "a: 1\n" * 999)
    Configuration(parser, None).save_config(SimpleNamespace(default_root_dir=path.parent), None, "fit")


def scores(path):
    report = TestReport(path.parent)
    report._rows = [[torch.zeros(3, 4, 4)]]
    report._scores = {"TFI": [(1.0,) * len(report.columns())] * 999}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lightning_modules.tasks.callbacks.write_picture", lambda *_: None)
        report.on_test_end(SimpleNamespace(is_global_zero=True, world_size=1, datamodule=None), None)


def program(path, kind="torch"):
    network = ClassicalDecoder("tfp", 2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.export, "export", lambda *_, **__: None)  # it takes half a minute
        patch.setattr(export, f"_{kind}", lambda *_: bytes(9999))
        patch.setattr(export, "_check_onnx", lambda: None)
        patch.setattr(export, "exported", lambda *_: network)
        export.export_network(network, path, kind)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("a.ckpt", lambda path: Checkpoints().save_checkpoint({"state_dict": {"a": torch.rand(9999)}}, path)),
        ("a.safetensors", lambda path: write_weights(Weights(path, {}, {}, {"a": torch.rand(9999)}), path)),
        ("a.json", lambda path: write_json(path, list(range(9999)))),
        ("sweep.csv", sweep_csv),
        ("sweep.md", sweep_md),
        ("trade.csv", trade_csv),
        ("config.yaml", configuration),
        ("test.csv", scores),
        ("a.pt2", program),
        ("a.onnx", lambda path: program(path, "onnx")),
    ],
)
def test_a_file_stays_whole(name, write, stays_whole):
    stays_whole(name, write)


def test_constants_of_weights_stay_whole(full_disk, tmp_path):
    for name in ("a", "b"):
        before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
        for room in (0, 20):
            with full_disk(room), pytest.raises(OSError, match=FILE):
                write_error_model(tmp_path / f"{name}.safetensors", ErrorModel())
            assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
        write_error_model(tmp_path / f"{name}.safetensors", ErrorModel())
    assert [path.name for path in tmp_path.iterdir()] == [FILE]


def test_a_trial_is_written_again_where_its_budget_is_missing(full_disk, tmp_path):
    for room, config, left in ((0, TRIAL, []), (20, {"a": 1}, ["trial.yaml"])):
        trial = Trial(("a",), None, tmp_path / "trial", config, {"steps": 10**100})
        with full_disk(room), pytest.raises(OSError, match="too large"):
            trial.write()
        assert [path.name for path in trial.folder.iterdir()] == left
    Trial(("a",), None, tmp_path / "trial", TRIAL, {"steps": 6}).write()
    assert yaml.safe_load((tmp_path / "trial" / "trial.yaml").read_text()) == TRIAL


def test_a_predicted_picture_is_there_whole_or_not_at_all(full_disk, tmp_path):
    write_spikes(tmp_path / "clip.npz", torch.rand(41, 24, 32, generator=torch.Generator().manual_seed(0)) < 0.3)
    words = ["predict", str(tmp_path / "clip.npz"), "--weights", "cscsr_tiny_x4", "-o", str(tmp_path / "out")]
    with full_disk(6000), pytest.raises(SystemExit, match=r"frame_000020.png: File too large"):
        main(words)
    assert [path.name for path in (tmp_path / "out").iterdir()] == [".predict.lock"]
    main(words)
    assert (tmp_path / "out" / "frame_000020.png").stat().st_size > 6000


def test_the_cache_goes_on_without(full_disk, tmp_path):
    cache = ClipCache(tmp_path)
    with full_disk(2000), warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        clip = {"spikes": torch.zeros(9, 99, 99), "rgb": torch.rand(3, 99, 99)}
        assert cache.packed("ab" * 32, lambda: clip)["rgb"].shape == (3, 99, 99)
    assert "cannot be written" in str(said[0].message)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]

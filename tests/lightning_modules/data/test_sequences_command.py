"""The ``lightning`` command on films."""

import csv
import re
import shutil
import sys
from pathlib import Path

import pytest
import yaml

from lightning_modules.__main__ import main
from lightning_modules.data.sequences import FilmScenes

SHARED = Path(__file__).parents[3].parent / "shared" / "data"

TINY = {
    "model": {
        "network": {
            "init_args": dict.fromkeys(
                ("width", "representation_width", "features", "stages", "blocks", "end_blocks"), 1
            )
        }
    },
    "data": {"init_args": {"patch": 8, "batch_size": 2, "workers": 0}},
    "trainer": {"max_steps": 2, "enable_progress_bar": False, "log_every_n_steps": 1, "check_val_every_n_epoch": 1},
}


@pytest.fixture
def command(tmp_path, configs, monkeypatch):
    """Run the command with a tiny network, after the overlay of a data set, in a folder of its own."""
    monkeypatch.setattr(sys, "argv", ["lightning"])
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(TINY))

    def run(verb, overlay, *args, scale=2):
        tiny = str(tmp_path / "tiny.yaml")
        configurations = [str(configs / f"x{scale}.yaml"), str(configs / "data" / f"{overlay}.yaml"), tiny]
        main([verb, *(part for path in configurations for part in ("-c", path)), *map(str, args)])

    return run


@pytest.mark.slow
def test_fit_and_test_on_reds(tmp_path, command, capsys, reds):
    reds(tmp_path / "reds", count=7)
    root = "--data.root", tmp_path / "reds"
    command("fit", "films", *root, "-o", tmp_path / "run", "--trainer.max_steps", 5)
    assert len(list((tmp_path / "runs" / "clips").glob("*/*.npz"))) == 15
    config = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())["data"]
    assert config["class_path"] == "lightning_modules.data.FilmScenes"
    assert config["init_args"]["cache"] == "runs/clips"
    command("test", "films", *root, "-o", tmp_path / "run", "--ckpt_path", "best", "--data.seed", 1)
    assert "mean of 5 clips" in capsys.readouterr().out


def test_the_data_follow_the_network(command, monkeypatch):
    def stop(self, stage):
        raise ValueError(f"{stage}: {self.options}")

    monkeypatch.setattr(FilmScenes, "setup", stop)
    network = [f"--model.network.{name}" for name in ("alpha=0.3", "frames=39", "window=9")]
    with pytest.raises(SystemExit) as exit:
        command("validate", "films", "--data.root", "nowhere", *network, scale=3)
    for option in ("validate:", "'scale': 3,", "'frames': 39,", "'alpha': 0.3,", "'flow_times': (4, 34),"):
        assert option in str(exit.value)


@pytest.mark.slow
def test_test_on_vid4_names_every_clip(tmp_path, command, capsys, write_film):
    write_film(tmp_path / "vid4/GT/walk", 3)
    write_film(tmp_path / "vid4/GT/city", 3, (40, 32))
    command("test", "films", "--data.root", tmp_path / "vid4", "-o", tmp_path / "run")
    printed = capsys.readouterr().out
    assert "mean of 2 clips" in printed
    rows = list(csv.DictReader((tmp_path / "run" / "test.csv").open()))
    assert [row["clip"] for row in rows] == ["city/00000001", "walk/00000001", "mean"] * 4
    assert [row["method"] for row in rows[::3]] == ["TFI", "TFP", "CSCSR", "CSCSR, true flow"]
    for row in rows[2::3]:
        assert re.search(rf"\| {row['method']} +\| {float(row['psnr']):.2f} +\|", printed)


@pytest.mark.slow
def test_fit_on_vimeo_and_on_films_without_flow(tmp_path, command, capsys, write_film, septuplets):
    septuplets(tmp_path / "vimeo", ["00001/0001", "00001/0002", "00002/0001"])
    (tmp_path / "vimeo/sep_trainlist.txt").write_text("00001/0001\n00002/0001\n")
    (tmp_path / "vimeo/sep_testlist.txt").write_text("00001/0002\n")
    command("fit", "films", "--data.patch", 16, "--data.root", tmp_path / "vimeo", "-o", tmp_path / "run", scale=4)
    for name in ("a", "b"):
        write_film(tmp_path / "films" / name, 4)
    blended = "--data.root", tmp_path / "films", "--data.interpolation", "spikekit.flow.interpolate.Blend"
    command("fit", "films", *blended, "--data.flow", "false", "-o", "other")
    assert (tmp_path / "other" / "checkpoints" / "best.ckpt").is_file()
    command("test", "films", *blended, "--data.flow", "false", "-o", "other", "--ckpt_path", "best")
    printed = capsys.readouterr().out
    assert "\n| CSCSR " in printed
    assert "true flow" not in printed


@pytest.mark.parametrize(
    ("verb", "overlay", "args", "message"),
    [
        ("fit", "films", ["--data.root", "nowhere"], "nowhere: no such folder of films"),
        ("fit", "films", ["--data.root", "."], "expected one of\n  REDS 120 fps   train/train_orig/000/"),
        ("test", "films", ["--data.root", "vid4", "--data.pattern", "BGGR"], "data.pattern: expected RGGB"),
        ("fit", "films", ["--data.root", "vid4"], "Vid4 without sequences for fit"),
    ],
)
def test_errors_come_before_anything_is_written(tmp_path, command, verb, overlay, args, message, write_film):
    write_film(tmp_path / "vid4" / "walk", 3)
    if args[1] == ".":
        shutil.rmtree(tmp_path / "vid4")
    with pytest.raises(SystemExit) as exit:
        command(verb, overlay, *args, "-o", tmp_path / "run")
    assert str(exit.value).startswith("lightning: ")
    assert message in str(exit.value)
    assert not (tmp_path / "run").exists()

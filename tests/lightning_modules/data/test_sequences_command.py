"""The ``lightning`` command on films."""

import csv
import re

import pytest
import yaml

from lightning_modules.__main__ import main
from lightning_modules.data.sequences import FilmScenes

WIDTHS = dict.fromkeys(("width", "representation_width", "features", "stages", "blocks", "end_blocks"), 1)
TINY = {
    "model": {"network": {"init_args": WIDTHS}},
    "data": {"init_args": {"patch": 8, "batch_size": 2, "workers": 0}},
    "trainer": {"max_steps": 2, "enable_progress_bar": False, "log_every_n_steps": 1, "check_val_every_n_epoch": 1},
}


@pytest.fixture
def command(tmp_path, configs, monkeypatch):
    """Run the command with a tiny network on films, in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(TINY))

    def run(verb, *args, scale=2):
        configurations = [configs / f"x{scale}.yaml", configs / "data" / "films.yaml", tmp_path / "tiny.yaml"]
        main([verb, *(str(part) for path in configurations for part in ("-c", path)), *map(str, args)])

    return run


@pytest.mark.slow
def test_fit_and_test_on_reds(tmp_path, command, capsys, reds):
    reds(tmp_path / "reds", count=7)
    root = "--data.root", tmp_path / "reds"
    command("fit", *root, "-o", tmp_path / "run", "--trainer.max_steps", 5)
    assert len(list((tmp_path / "runs" / "clips").glob("*/*.npz"))) == 15
    config = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())["data"]
    assert config["class_path"] == "lightning_modules.data.FilmScenes"
    assert config["init_args"]["cache"] == "runs/clips"
    command("test", *root, "-o", tmp_path / "run", "--ckpt_path", "best", "--data.seed", 1)
    assert "mean of 5 clips" in capsys.readouterr().out


def test_data_options_follow_the_network(command, monkeypatch):
    def stop(self, stage):
        raise ValueError(f"{stage}: {self.options}")

    monkeypatch.setattr(FilmScenes, "setup", stop)
    network = [f"--model.network.{name}" for name in ("alpha=0.3", "frames=39", "window=9")]
    with pytest.raises(SystemExit) as exit:
        command("validate", "--data.root", "nowhere", *network, scale=3)
    for option in ("validate:", "'scale': 3,", "'frames': 39,", "'alpha': 0.3,", "'flow_times': (4, 34),"):
        assert option in str(exit.value)


@pytest.mark.slow
def test_test_on_vid4_names_all_clips(tmp_path, command, capsys, write_film):
    write_film(tmp_path / "vid4/GT/walk", 3)
    write_film(tmp_path / "vid4/GT/city", 3, (40, 32))
    command("test", "--data.root", tmp_path / "vid4", "-o", tmp_path / "run")
    printed = capsys.readouterr()
    assert "mean of 2 clips" in printed.out
    assert "note: no weights given, those of CSCSR are random (see lightning test --help)\n" in printed.err
    rows = list(csv.DictReader((tmp_path / "run" / "test.csv").open()))
    assert [row["clip"] for row in rows] == ["city/00000001", "walk/00000001", "mean"] * 4
    assert [row["method"] for row in rows[::3]] == ["TFI", "TFP", "CSCSR", "CSCSR, true flow"]


@pytest.mark.slow
def test_fit_on_vimeo_and_on_films_without_flow(tmp_path, command, capsys, write_film, septuplets):
    septuplets(tmp_path / "vimeo", ["00001/0001", "00001/0002", "00002/0001"])
    (tmp_path / "vimeo/sep_trainlist.txt").write_text("00001/0001\n00002/0001\n")
    (tmp_path / "vimeo/sep_testlist.txt").write_text("00001/0002\n")
    command("fit", "--data.patch", 16, "--data.root", tmp_path / "vimeo", "-o", tmp_path / "run", scale=4)
    for name in ("a", "b"):
        write_film(tmp_path / "films" / name, 4)
    blended = "--data.root", tmp_path / "films", "--data.interpolation", "spikekit.flow.interpolate.Blend"
    command("fit", *blended, "--data.flow", "false", "-o", "other")
    assert (tmp_path / "other" / "checkpoints" / "best.ckpt").is_file()
    command("test", *blended, "--data.flow", "false", "-o", "other", "--ckpt_path", "best")
    printed = capsys.readouterr().out
    assert "\n| CSCSR " in printed
    assert "true flow" not in printed


@pytest.mark.parametrize(
    ("root", "message"),
    [
        ("nowhere", "nowhere: no such folder of films"),
        (".", "expected one of\n  REDS 120 fps   train/train_orig/000/"),
        ("vid4", "Vid4 without sequences for fit"),
    ],
)
def test_errors_are_raised_before_anything_is_written(tmp_path, command, root, message, write_film):
    if root == "vid4":
        write_film(tmp_path / "vid4" / "walk", 3)
    with pytest.raises(SystemExit, match=f"^lightning: .*{re.escape(message)}"):
        command("fit", "--data.root", root, "-o", tmp_path / "run")
    assert not (tmp_path / "run").exists()

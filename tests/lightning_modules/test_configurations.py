"""Lookup of configurations by name, and a test that each of them builds."""

from pathlib import Path

import pytest
import torch
import yaml

from lightning_modules.__main__ import main
from lightning_modules.configurations import find_configs, with_found_configs
from lightning_modules.networks import CSCSR, RecurrentCSCSR
from lightning_modules.networks.sizes import SIZES

NAMES = ["x1", "x2", "x3", "x4", "quick", "flow", "ablation/a", "grey", "data/films", "motion/spike2flow"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("typed", ["{}", "{}.yaml", "configs/{}", "configs/{}.yaml"])
def test_configurations_are_found_from_any_folder(name, typed, tmp_path, monkeypatch, configs):
    monkeypatch.chdir(tmp_path)
    (found,) = find_configs(typed.format(name))
    assert Path(found).samefile(configs / f"{name}.yaml")


def test_local_files_take_precedence(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("x4", "configs/x4.yaml"):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text("output: mine")
        assert find_configs(name) == [name]


@pytest.mark.parametrize("name", ["nowhere", "../x4", "/x4", "{model: {flow: scene}}", "", "a\nb", "x" * 5000])
def test_unknown_names_are_returned_unchanged(name):
    assert find_configs(name) == [name]


def test_all_forms_of_the_option(configs):
    x4 = str(configs / "x4.yaml")
    typed = ["fit", "-c", "x4", "--config", "x4", "--config=x4", "-cx4", "--ckpt_path", "x4"]
    expected = ["fit", "-c", x4, "--config", x4, f"--config={x4}", f"-c{x4}", "--ckpt_path", "x4"]
    assert with_found_configs(typed) == expected


def test_command_finds_configurations_from_an_empty_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["lightning"])
    with pytest.raises(SystemExit):
        main(["fit", "-c", "x4", "-c", "configs/quick.yaml", "-c", "ablation/b", "--print_config"])
    network = yaml.safe_load(capsys.readouterr().out)["model"]["init_args"]["network"]["init_args"]
    assert (network["scale"], network["size"], network["global_perception"]) == (4, "small", False)


@pytest.mark.parametrize("scale", [1, 2, 3, 4])
def test_every_size_builds_at_every_scale(scale, configs):
    said, quick, gpu = (
        yaml.safe_load((configs / f"{name}.yaml").read_text())["model"]["network"]["init_args"]
        for name in (f"x{scale}", "quick", "gpu")
    )
    for size in ({}, *({"size": name} for name in SIZES)):
        with torch.device("meta"):
            assert CSCSR(**{**said, **quick, **size}).scale == scale
    with torch.device("meta"):
        assert RecurrentCSCSR(**{**said, **gpu}).scale == scale

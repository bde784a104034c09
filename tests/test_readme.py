import re
from pathlib import Path

import torch

README = (Path(__file__).parents[1] / "README.md").read_text()


def test_the_python_runs_and_gradients_reach_the_scene():
    operators, trained = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    names: dict = {}
    exec(operators, names)
    exec(trained, names)
    assert names["rgb"].shape == (1, 3, 64, 64)
    assert names["moved"].shape == (1, 1, 16, 16)
    assert names["scene"].grad.isfinite().all()
    assert names["scene"].grad.abs().sum() > 0
    assert not torch.equal(names["moved"][0, 0], names["raw"])


def test_what_it_names_is_there():
    root = Path(__file__).parents[1]
    named = re.findall(r"(?:configs|docs)/[\w/]+\.(?:yaml|png)", README) + re.findall(r"\]\((?!http)([^)]+)\)", README)
    assert len(named) > 10
    for name in named:
        assert (root / name).is_file(), name


def test_it_is_read_in_a_few_minutes():
    assert len(README.splitlines()) <= 120


def test_its_first_two_commands_are_those_that_ci_runs():
    train, test = re.findall(r"```sh\n(.*?)\n```", README, flags=re.DOTALL)[:2]
    assert "configs/quick.yaml" in train
    assert train.endswith("--ckpt_path best")
    assert test.endswith("pytest -n auto")

import re
from pathlib import Path

import torch

README = (Path(__file__).parents[1] / "README.md").read_text()


def test_the_python_runs_and_gradients_reach_the_scene():
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    names: dict = {}
    exec(code, names)
    assert names["moved"].shape == (1, 1, 16, 16)
    assert names["scene"].grad.isfinite().all()
    assert names["scene"].grad.abs().sum() > 0
    assert not torch.equal(names["moved"][0, 0], names["raw"])


def test_what_it_names_is_there():
    root = Path(__file__).parents[1]
    for name in re.findall(r"(?:configs|docs)/[\w/]+\.(?:yaml|png)", README):
        assert (root / name).is_file(), name

import re
from pathlib import Path

import torch

README = (Path(__file__).parents[1] / "README.md").read_text()


def test_the_python_runs_and_gradients_reach_the_scene():
    trained, own = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    names: dict = {}
    exec(trained, names)
    assert names["rgb"].shape == (1, 3, 96, 128)
    exec(own, names)
    assert names["moved"].shape == (1, 1, 16, 16)
    assert names["scene"].grad.isfinite().all()
    assert names["scene"].grad.abs().sum() > 0
    assert not torch.equal(names["moved"][0, 0], names["raw"])


def test_what_it_names_is_there():
    root = Path(__file__).parents[1]
    for name in re.findall(r"(?:configs|docs)/[\w/]+\.(?:yaml|png)", README):
        assert (root / name).is_file(), name

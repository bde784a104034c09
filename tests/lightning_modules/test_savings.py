import pytest
import torch

from lightning_modules.networks import CSCSR
from lightning_modules.savings import main, rows, scenes


def test_what_a_tolerance_saves_and_costs():
    generator = torch.Generator().manual_seed(0)
    ground, thing = torch.rand(2, 3, 64, 64, generator=generator)
    network = CSCSR(2, width=4, representation_width=4, features=1, stages=1, end_blocks=1, skip=True)
    found = {name: list(rows(network, scene, (0.1, 100.0), 32, 1)) for name, scene in scenes(ground, thing, 32, 48, 2)}
    assert list(found) == ["still", "mixed", "fast"]
    for careful, careless in found.values():
        assert (careful[0], careless[0]) == (0.1, 100.0)
        assert careful[4] == 1  # every cell has texture
        assert careless[4] == careless[5] == 0
        assert careful[-1] == pytest.approx(0, abs=0.1)
    still, mixed, fast = (both[0][5] for both in found.values())
    assert still == 0
    assert still <= mixed <= fast
    assert fast == 1


def test_tiles_are_even(capsys):
    with pytest.raises(SystemExit):
        main(["x4-e", "--tile", "63"])
    said = "argument --tile: expected an even number of sensor pixels, or 0 for no tiles, got 63"
    assert said in capsys.readouterr().err

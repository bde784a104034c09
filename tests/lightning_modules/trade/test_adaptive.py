import shutil

import numpy as np
import pytest
import torch

from lightning_modules.data.pictures import embedded_pictures
from lightning_modules.inference.tiles import forward_in_tiles
from lightning_modules.networks import CSCSR
from lightning_modules.storage.error_model import ErrorModel
from lightning_modules.storage.shipped import shipped_weights
from lightning_modules.trade.adaptive import main, rows, scenes
from lightning_modules.trade.error_fit import _envelope, make_clips
from spikekit import psnr


def test_what_a_tolerance_saves_and_costs():
    generator = torch.Generator().manual_seed(0)
    ground, thing = torch.rand(2, 3, 64, 64, generator=generator)
    network = CSCSR(2, width=4, representation_width=4, features=1, stages=1, end_blocks=1, skip=True)
    network.error_model = ErrorModel(
        flat=2.5, grainy=0.3, blurred=0.08, still=0.05, textured=1.5, moved=0.02, faint=1e-4
    )
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
        main(["cscsr_small_x4", "--tile", "63"])
    said = "argument --tile: expected an even number of sensor pixels, or 0 for no tiles, got 63"
    assert said in capsys.readouterr().err


def test_factors_stay_above_what_they_are_fitted_to():
    """Asymmetric least squares: the optimum of the weighted squares, found by brute force."""
    generator = np.random.default_rng(0)
    statistic = generator.uniform(0.5, 1.5, 400)
    target = statistic * generator.uniform(0, 2, 400)
    (factor,) = _envelope([statistic], target, np.ones(400), 0.9)
    tried = np.linspace(0, 2, 2001)
    errors = [np.where(target > n * statistic, 0.9, 0.1) @ (target - n * statistic) ** 2 for n in tried]
    assert factor == pytest.approx(tried[np.argmin(errors)], abs=2e-3)
    assert factor > 1.2  # the plain fit is 1


def test_fitted_constants_keep_the_tolerance_on_clips_that_were_not_fitted(tmp_path, capsys):
    name = "cscsr_tiny_x4"
    file = tmp_path / "tiny.safetensors"
    shutil.copy(shipped_weights()[name], file)
    main([str(file), "--fit", "--clips", "4"])
    _, _, *lines = capsys.readouterr().out.splitlines()
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert [(cells[0], cells[1]) for cells in table] == [(str(file), "0.1"), (str(file), "0.5")]
    assert all(float(cells[2]) <= float(cells[1]) for cells in table)
    assert float(table[1][4].rstrip("%")) < 100  # and something is saved
    fitted = CSCSR.from_pretrained(file).error_model
    assert fitted != ErrorModel()


def test_shipped_constants_keep_the_tolerance_in_tiles():
    """Not the cells one by one, but what predict does."""
    network = CSCSR.from_pretrained("cscsr_tiny_x4")
    settings = 4, network.pattern, network.settings["alpha"], network.frames
    saved = []
    for clip in make_clips(embedded_pictures(held_out=True), 4, *settings):
        pictures = [forward_in_tiles(network, clip.spikes, 32, tolerance) for tolerance in (0.0, 0.1, 0.5)]
        best, *others = (psnr(rgb[0].clamp(0, 1), clip.truth).item() for rgb in pictures)
        assert best - others[0] <= 0.1
        assert best - others[1] <= 0.5
        saved.append(others[1] != best)
    assert any(saved)


def test_constants_are_written_beside_files_of_safetensors_only(tmp_path):
    with pytest.raises(FileNotFoundError):
        main([str(tmp_path / "none.safetensors"), "--fit"])

import pytest
import torch

from spikekit import write_picture
from spikekit.bench.demosaicing import main


@pytest.fixture
def waves():
    """Pictures of waves that go a pixel a frame, to the right; their colours differ by little."""

    def picture(n):
        rows, columns = torch.meshgrid(torch.arange(64) / 1.5, torch.arange(64) / 1.5, indexing="ij")
        grey = 0.5 + 0.3 * (columns - n / 1.5).sin() * rows.cos()
        return torch.stack([0.9 * grey, grey, 0.8 * grey + 0.1])

    return picture


def cells(said):
    return {name: values for name, *values in ([cell.strip() for cell in line.split("|")[1:-1]] for line in said)}


def test_table(waves, tmp_path, capsys):
    write_picture(tmp_path / "stills" / "a.png", waves(0))
    for n in range(5):
        write_picture(tmp_path / "films" / "waves" / f"{n}.png", waves(n))
    main(["--pictures", str(tmp_path / "stills"), "--films", str(tmp_path / "films"), "--clocks", "10"])
    table = cells(capsys.readouterr().out.splitlines())
    assert table["mosaic of"] == ["demosaic", "demosaic_residual", "demosaic_along_motion"]
    plain, residual, along = table["stills"]
    assert float(residual) > float(plain) + 3
    assert along == "-"
    plain, residual, along = map(float, table["waves, TFI, 10 clocks, alpha 0.4"])
    assert along > residual + 1 > plain + 1


def test_films_that_are_too_short_and_folders_of_nothing(waves, tmp_path, capsys):
    for n in range(4):
        write_picture(tmp_path / "films" / "waves" / f"{n}.png", waves(n))
    with pytest.raises(ValueError, match="waves: expected 5 frames or more, got 4"):
        main(["--films", str(tmp_path / "films"), "--clocks", "10"])
    with pytest.raises(ValueError, match="films: holds no pictures"):
        main(["--pictures", str(tmp_path / "films")])
    with pytest.raises(SystemExit):
        main([])
    assert "expected --pictures or --films" in capsys.readouterr().err

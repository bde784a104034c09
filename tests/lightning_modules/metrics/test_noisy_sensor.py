import torch

from lightning_modules.metrics import noisy_sensor
from spikekit import write_picture


def test_the_better_a_sensor_is_known_the_better_are_its_pictures(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(noisy_sensor, "PATCH", 40)
    waves = torch.linspace(0, 40, 320).sin()
    write_picture(tmp_path / "waves.png", (0.5 + 0.3 * waves * waves[:, None]).expand(3, -1, -1))
    monkeypatch.setattr("sys.argv", ["noisy_sensor", str(tmp_path), "--weights", "cscsr_tiny_x4", "--count", "1"])
    noisy_sensor.main()
    head, _, *rows = ([cell.strip() for cell in line.split("|")[1:-1]] for line in capsys.readouterr().out.splitlines())
    assert head == ["waves.png", "TFI", "TFP 13, order 3", "cscsr_tiny_x4"]
    assert [row[0] for row in rows] == [
        "none",
        "from the scene: dead and hot pixels",
        "from the scene in motion",
        "from a flat and a dark recording",
        "none, an ideal sensor",
    ]
    for scores in zip(*(map(float, row[1:]) for row in rows), strict=True):
        assert list(scores) == sorted(scores)
        assert scores[3] > scores[0] + 3

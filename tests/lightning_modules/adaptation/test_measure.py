import torch

from lightning_modules.adaptation import measure
from spikekit import write_picture


def test_the_table(tmp_path, monkeypatch, capsys):
    """A teacher that is the student has nothing to teach; what is before on a recording is so beside the other's."""
    monkeypatch.setattr(measure, "PATCH", 24)
    monkeypatch.setattr(measure, "FRAMES", 140)
    waves = torch.linspace(0, 40, 320).sin()
    for name, dark in (("a.png", 0.3), ("b.png", 0.1)):
        write_picture(tmp_path / name, (0.5 + dark * waves * waves[:, None]).expand(3, -1, -1))
    same = ["--weights", "cscsr_tiny_x4", "--teacher", "cscsr_tiny_x4", "--count", "2", "--steps", "1"]
    monkeypatch.setattr("sys.argv", ["measure", str(tmp_path), *same])
    measure.main()
    out = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    head, _, *rows = ([cell.strip() for cell in line.split("|")[1:-1]] for line in out)
    assert head[:4] == ["", "before", "after", "teacher"]
    assert [row[0] for row in rows] == ["a.png", "b.png", "mean"]
    (a, b, mean) = ([float(cell) for cell in row[1:]] for row in rows)
    assert (a[0], b[0]) == (a[2], b[2]) == (b[5], a[5])
    assert a[0] != b[0]
    assert min(a[3], b[3]) > 55 > max(a[4], b[4]) > 20
    assert abs(mean[0] - (a[0] + b[0]) / 2) < 0.011
    assert min(a[0], b[0]) > 15

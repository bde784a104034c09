import pytest
import torch

from lightning_modules.metrics import flow_noise
from spikekit import write_picture


@pytest.fixture
def films(tmp_path):
    """A film of waves that go half a sensor pixel a frame, to the right."""
    rows, columns = torch.meshgrid(torch.arange(128) / 6, torch.arange(128) / 6, indexing="ij")
    for n in range(5):
        write_picture(
            tmp_path / "films" / "waves" / f"{n}.png",
            0.5 + 0.3 * torch.stack([(columns - n / 3).sin() * (rows + phase).cos() for phase in (0.0, 0.3, 0.6)]),
        )
    return tmp_path / "films"


def test_noise_in_the_flows_harms_most_where_they_are_not_joined(films, capsys):
    flow_noise.main([str(films), "--weights", "cscsr_tiny_x4", "--noises", "0", "3"])
    head, _, *rows = ([cell.strip() for cell in line.split("|")[1:-1]] for line in capsys.readouterr().out.splitlines())
    assert head == ["noise (px)", "J", "D", "E"]
    without, noisy = ([float(cell) for cell in row[1:]] for row in rows)
    assert [row[0] for row in rows] == ["0", "3"]
    assert max(without) - min(without) < 0.1
    assert without[0] - 1 > noisy[0] > noisy[1] + 1 > noisy[2] + 2


@pytest.mark.parametrize("smooth", [0.0, 2.0])
def test_the_noise_is_as_strong_as_asked_for_and_always_the_same(smooth):
    spikes = (torch.rand(1, 41, 64, 64, generator=torch.Generator().manual_seed(0)) < 0.3).float()
    motion = flow_noise.NoisyFlow(smooth)
    quiet = torch.stack(motion.channel_flows(spikes, (5, 20, 35), "RGGB"))
    motion.noise = 3.0
    noisy, again = (torch.stack(motion.channel_flows(spikes, (5, 20, 35), "RGGB")) for _ in range(2))
    assert torch.equal(noisy, again)
    errors = noisy - quiet
    assert errors.std().item() == pytest.approx(1.5, rel=0.05)  # half a cell is a sensor pixel
    beside = (errors[..., 1:] * errors[..., :-1]).mean() / errors.square().mean()
    assert beside > 0.8 if smooth else beside.abs() < 0.1

"""Schedule by steps or time, progress lines, and written weights."""

import pytest
import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import EMAWeightAveraging
from torch.utils.data import DataLoader

from lightning_modules.networks import CSCSR
from lightning_modules.tasks.pace import Pace

TINY = {"scale": 2, "width": 8, "representation_width": 8, "features": 1, "stages": 1, "end_blocks": 1}


class Learns(pl.LightningModule):
    def __init__(self):
        super().__init__()
        self.network, self.rates = CSCSR(**TINY), []

    def training_step(self, batch):
        self.rates.append(self.optimizers().param_groups[0]["lr"])
        return (self.network(batch["spikes"], static=True) - batch["rgb"]).abs().mean()

    def configure_optimizers(self):
        optimizer = torch.optim.SGD(self.network.parameters(), 0.1)
        schedule = torch.optim.lr_scheduler.ConstantLR(optimizer, 1.0)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def train(folder, *callbacks, **how):
    torch.manual_seed(0)
    module = Learns()
    clip = {"spikes": torch.ones(41, 8, 8), "rgb": torch.zeros(3, 16, 16)}
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    trainer = pl.Trainer(
        accelerator="cpu", default_root_dir=folder, callbacks=[*callbacks], enable_model_summary=False, **quiet, **how
    )
    trainer.fit(module, DataLoader([clip] * 200, batch_size=2))
    return module


def test_learning_rate_rises_then_falls_to_the_last_step(tmp_path):
    rates = train(tmp_path, Pace(warm_up=5), max_steps=40).rates
    assert rates[:5] == sorted(rates[:5])
    assert rates[5:] == sorted(rates[5:], reverse=True)
    assert max(rates) == pytest.approx(0.1, rel=0.1)
    assert rates[-1] < 0.002


def test_schedule_ends_with_time(tmp_path):
    rates = train(tmp_path, Pace(warm_up=1), max_time="00:00:00:02", max_epochs=-1).rates
    assert rates[0] > 0.09
    assert rates[-1] < 0.02


def test_progress_lines_show_steps_and_clips(tmp_path, capfd):
    train(tmp_path, Pace(line_every=0), max_steps=4)
    lines = capfd.readouterr().out.splitlines()
    assert len(lines) == 4
    assert lines[-1].startswith("step 4, 100%: ")
    assert "clips/s" in lines[-1]


def test_averaged_weights_with_settings_are_written(tmp_path):
    module = train(tmp_path / "plain", Pace(), max_steps=5)
    read = CSCSR.from_pretrained(tmp_path / "plain" / "weights.safetensors")
    for name, value in module.network.state_dict().items():
        torch.testing.assert_close(read.state_dict()[name], value.half().float(), atol=1e-3, rtol=1e-3)
    average = EMAWeightAveraging(decay=1.0)  # nothing is learned
    train(tmp_path / "average", Pace(weights_every=0), average, max_steps=5)
    torch.manual_seed(0)
    first, kept = Learns().network, CSCSR.from_pretrained(tmp_path / "average" / "weights.safetensors")
    apart = [(kept.state_dict()[name] - value.half().float()).abs().max() for name, value in first.state_dict().items()]
    gone = [(read.state_dict()[name] - value.half().float()).abs().max() for name, value in first.state_dict().items()]
    assert max(apart) < max(gone)

"""Training of optical flow (``configs/flow.yaml``), and its use in CSCSR."""

import csv

import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from lightning_modules.__main__ import main
from lightning_modules.motion import Spike2Flow, ZeroFlow
from lightning_modules.networks import CSCSR
from lightning_modules.tasks.optical_flow import FlowTraining
from lightning_modules.tasks.super_resolution import SuperResolution
from spikekit import read_picture, split_bayer

TINY = """
model:
  init_args:
    network:
      init_args: {widths: [4], features: 4, hidden: 4, correlation: [4, 4], motion: 4, head: 4, iterations: 2}
data:
  init_args: {patch: 8, val_patch: 12, train_clips: 8, val_clips: 3, batch_size: 2, workers: 0}
trainer:
  max_steps: 4
  check_val_every_n_epoch: 1
  log_every_n_steps: 2
  enable_progress_bar: false
"""
CSCSR_TINY = {"width": 4, "representation_width": 4, "features": 1, "stages": 1, "blocks": 1, "end_blocks": 1}
FLOW_TINY = yaml.safe_load(TINY)["model"]["init_args"]["network"]["init_args"]


@pytest.fixture
def batch():
    generator = torch.Generator().manual_seed(0)
    return {
        "spikes": (torch.rand(2, 41, 12, 12, generator=generator) < 0.3).to(torch.uint8),
        "flow": 2 * torch.randn(2, 2, 2, 12, 12, generator=generator),
        "rgb": torch.rand(2, 3, 24, 24, generator=generator),
    }


def test_loss_discounts_earlier_iterations(batch, monkeypatch):
    module = FlowTraining(Spike2Flow(**FLOW_TINY), pattern="GRBG")
    monkeypatch.setattr(module, "log", lambda *_, **__: None)
    cells = split_bayer(batch["flow"], "GRBG") / 2
    exact = torch.stack([cells / 3, cells * 2 / 3, cells], dim=3)
    monkeypatch.setattr(module.network, "refinements", lambda *_: [exact, exact + 3, exact - 1])
    assert module.training_step(batch, 0).item() == pytest.approx(0.8 * 3 + 1, rel=1e-5)


def test_validation_measures_the_joint_flow_and_zero_flow(batch, monkeypatch):
    shares = torch.full((12, 12), 0.5)
    batch["flow"][:, :, :, 0, 0], shares[0, 0] = torch.tensor([60.0, 80.0]), 0.96  # an error of 4 pixels, and of 4 %

    class Shares(Spike2Flow):
        def forward(self, *_):
            return (batch["flow"] * shares).unbind(1)

    logged = {}
    module = FlowTraining(Shares(**FLOW_TINY))
    monkeypatch.setattr(module, "log", lambda name, value, **_: logged.update({name: value.item()}))
    module.validation_step(batch, 0)
    length = batch["flow"].norm(dim=2)
    for name, error in (("", length * (1 - shares)), ("_zero", length)):
        outliers = error > 3
        outliers[..., 0, 0] = name == "_zero"
        assert logged[f"val/epe{name}"] == pytest.approx(error.mean().item())
        assert logged[f"val/over_1px{name}"] == pytest.approx((error > 1).float().mean().item())
        assert logged[f"val/outliers{name}"] == pytest.approx(outliers.float().mean().item())
    assert 0 < logged["val/outliers"] < logged["val/outliers_zero"]


def test_frozen_networks_are_rejected():
    with pytest.raises(ValueError, match="got a frozen one"):
        FlowTraining(Spike2Flow(**FLOW_TINY, frozen=True))


@pytest.mark.parametrize(("flow", "asked"), [("scene", 0), ("estimated", 1)])
def test_super_resolution_trains_with_the_chosen_flow(flow, asked, batch, monkeypatch):
    module = SuperResolution(CSCSR(2, **CSCSR_TINY, motion=Spike2Flow(**FLOW_TINY)), flow=flow)
    seen = []
    module.network.motion.register_forward_hook(lambda *of: seen.append(of))
    monkeypatch.setattr(module, "log", lambda *_, **__: None)
    module.training_step(batch, 0)
    assert len(seen) == asked


def test_estimator_of_a_checkpoint_can_be_replaced():
    def module(motion):
        return SuperResolution(CSCSR(2, **CSCSR_TINY, motion=motion))

    def saved(module):
        checkpoint = {"state_dict": module.state_dict()}
        module.on_save_checkpoint(checkpoint)
        return checkpoint

    def loaded(module, checkpoint):
        module.on_load_checkpoint(checkpoint)
        module.load_state_dict(checkpoint["state_dict"])
        return module.state_dict()

    learned, other, without = module(Spike2Flow(**FLOW_TINY)), module(Spike2Flow(**FLOW_TINY)), module(ZeroFlow())
    name = "network.motion.network.heads.0.0.weight"
    assert not learned.state_dict()[name].equal(other.state_dict()[name])
    own = other.state_dict()[name].clone()
    assert loaded(other, saved(without))[name].equal(own)
    assert loaded(other, saved(learned))[name].equal(learned.state_dict()[name])
    assert name not in loaded(without, saved(learned))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    output = tmp_path_factory.mktemp("run")
    (output / "tiny.yaml").write_text(TINY)
    main(["fit", "-c", "flow", "-c", str(output / "tiny.yaml"), "-o", str(output)])
    return output


@pytest.mark.slow
def test_fit_logs_errors_and_pictures(trained):
    events = EventAccumulator(str(trained)).Reload()
    measures = {f"val/{name}{of}" for name in ("epe", "over_1px", "outliers") for of in ("", "_zero")}
    assert {"train/loss", *measures} <= set(events.Tags()["scalars"])
    assert events.Tags()["images"] == ["val/flow, truth"]


@pytest.mark.slow
def test_test_compares_estimators_on_the_same_clips(trained, configs, capsys):
    args = ["test", "-c", configs / "flow.yaml", "-c", trained / "tiny.yaml", "-o", trained, "--ckpt_path", "best"]
    main([*map(str, args)])
    printed = capsys.readouterr().out
    estimators = ["Spike2Flow", "ClassicalFlow", "ZeroFlow"]
    assert all(f"\n| {name} " in printed for name in estimators)
    rows = list(csv.DictReader((trained / "test.csv").open()))
    assert list(rows[0]) == ["method", "clip", "epe", "over_1px", "outliers", "milliseconds"]
    assert [row["method"] for row in rows if row["clip"] == "mean"] == estimators
    for name in estimators:
        *each, mean = [float(row["epe"]) for row in rows if row["method"] == name]
        assert mean == pytest.approx(sum(each) / 3, abs=1e-4)
    assert read_picture(trained / "test.png").shape == (3, 3 * 12 + 2 * 4, 4 * 12 + 3 * 4)

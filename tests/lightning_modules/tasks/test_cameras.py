"""Training for cameras with different gains and noise levels, also grey ones."""

from __future__ import annotations

import pytest
import pytorch_lightning as pl
import torch
import yaml

from lightning_modules.__main__ import main
from lightning_modules.data.stills import StillScenes
from lightning_modules.networks import CSCSR, RecurrentCSCSR
from lightning_modules.storage.pretrained import Weights, settings_of, write_weights
from lightning_modules.tasks.super_resolution import SuperResolution
from spikekit import SensorNoise

TINY = {"width": 8, "representation_width": 8, "features": 1, "stages": 1, "end_blocks": 1, "noise": True}
DATA = {"patch": 12, "val_patch": 16, "train_clips": 8, "val_clips": 2, "batch_size": 2, "workers": 0}


@pytest.mark.parametrize(
    ("kind", "key_frames", "pattern"), [(CSCSR, 1, "grey"), (CSCSR, 2, "RGGB"), (RecurrentCSCSR, 2, "grey")]
)
def test_gains_and_noise_are_learned_at_scale_1(kind, key_frames, pattern, tmp_path):
    cameras = {"gains": (0.1, 1.0), "noise": SensorNoise(photons=500), "pattern": pattern, "key_frames": key_frames}
    data = StillScenes(scale=1, **DATA, **cameras)
    network = kind(scale=1, pattern=pattern, **TINY)
    trainer = pl.Trainer(
        max_steps=4, accelerator="cpu", logger=False, enable_checkpointing=False, default_root_dir=tmp_path
    )
    trainer.fit(SuperResolution(network), data)
    level = network.reconstruction.noise
    assert torch.isfinite(trainer.callback_metrics["val/psnr"])
    assert all(parameter.abs().max() > 0 for parameter in level.parameters())


def test_weights_for_ideal_sensors_are_trained_for_noise(configs, tmp_path, capsys):
    ideal, path = CSCSR(scale=1, **{**TINY, "noise": False}), tmp_path / "ideal.safetensors"
    write_weights(Weights(path, settings_of(ideal), {}, ideal.state_dict()), path)
    with pytest.raises(SystemExit):
        main(["fit", f"-c{configs}/x1.yaml", f"-c{configs}/cameras.yaml", f"--model.weights={path}", "--print_config"])
    run = yaml.safe_load(capsys.readouterr().out)
    assert CSCSR(**run["model"]["init_args"]["network"]["init_args"]).config.noise


def test_tests_tell_the_network_the_noise():
    module = SuperResolution(CSCSR(scale=1, pattern="grey", **TINY))
    module.log = lambda *_, **__: None
    torch.nn.init.ones_(module.network.reconstruction.noise.shift)
    torch.nn.init.normal_(module.network.reconstruction.rgb.weight)
    spikes = (torch.rand(1, 41, 12, 12) < 0.3).to(torch.uint8)
    batch = {"spikes": spikes, "rgb": torch.rand(1, 1, 12, 12), "noise": torch.ones(1)}
    told = module.test_step(batch, 0)["pictures"]["CSCSR"]
    torch.testing.assert_close(told, module.network(spikes, noise=1.0).clamp(0, 1))
    assert (told - module.network(spikes, noise=0.0).clamp(0, 1)).abs().max() > 0.1


def test_dim_clips_do_not_dominate_the_loss(tmp_path):
    """The errors of two clips, one with a hundredth of the light, fall by similar fractions."""
    module = SuperResolution(CSCSR(scale=1, pattern="grey", **TINY))
    module.log = lambda *_, **__: None
    spikes = (torch.rand(2, 41, 12, 12) < 0.3).to(torch.uint8)
    flow = torch.zeros(2, 2, 2, 12, 12)
    picture = module.network(spikes, flow).detach()

    def gradient_at(error: tuple[float, float]) -> torch.Tensor:
        """Of the bias that is added to all pictures, when they are off by so much, one up and one down."""
        off = torch.tensor(error).reshape(2, 1, 1, 1)
        batch = {"spikes": spikes, "flow": flow, "alpha": torch.full((2,), module.network.config.alpha)}
        module.zero_grad()
        module.training_step(batch | {"rgb": picture + off}, 0).backward()
        return module.network.reconstruction.rgb.bias.grad

    assert gradient_at((0.5, -0.5)).abs() < 1e-4
    assert gradient_at((0.5, -0.01)) > 0  # the small error pulls its own way harder: to the same share


@pytest.mark.parametrize("scale", [1, 4])
def test_configurations_for_grey_sensors_and_all_cameras(configs, scale, capsys):
    files = [part for name in (f"x{scale}", "grey", "cameras") for part in ("-c", str(configs / f"{name}.yaml"))]
    with pytest.raises(SystemExit):
        main(["fit", *files, "--print_config"])
    run = yaml.safe_load(capsys.readouterr().out)
    network = CSCSR(**run["model"]["init_args"]["network"]["init_args"])
    assert (network.scale, network.colors, network.config.noise) == (scale, 1, True)
    data = run["data"]["init_args"]
    assert data["pattern"] == "grey"
    assert data["gains"] == [0.03, 1.0]

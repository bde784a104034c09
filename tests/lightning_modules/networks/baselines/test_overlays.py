"""Baselines on the command line: training, test, export and prediction."""

import csv
from inspect import signature
from pathlib import Path

import pytest
import torch
import yaml

from lightning_modules import networks
from lightning_modules.__main__ import main
from lightning_modules.data import StillScenes
from lightning_modules.storage.pretrained import read_weights
from spikekit import read_picture, write_spikes

CONFIGS = Path(__file__).parents[4] / "configs"
BASELINES = ["BasicVSR", "RealRawVSR", "SpikeSRNetLike", "SwinIR", "TSCNN", "VidarSR"]

TINY = {"BasicVSR": {"width": 4, "blocks": 1}, "RealRawVSR": {"width": 8, "blocks": 2}}


@pytest.mark.parametrize("name", BASELINES)
def test_baselines_share_only_common_settings_with_configurations_of_cscsr(name):
    """A baseline named after a configuration keeps its settings of the same name."""
    kind = getattr(networks, name)
    for below in ("x2", "x3", "x4", "quick"):
        said = yaml.safe_load((CONFIGS / f"{below}.yaml").read_text())["model"]["network"]["init_args"]
        assert said.keys() & signature(kind).parameters.keys() <= {"scale", "frames", "pattern", "skip"}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["BasicVSR", "RealRawVSR"])  # with a flow, and without
def test_train_test_export_and_predict(kind, tmp_path):
    scale = 2 + BASELINES.index(kind) % 3
    configs = ["-c", f"x{scale}", "--model.network", kind]
    tiny = [f"--model.network.{name}={value}" for name, value in TINY[kind].items()]
    small = ["patch=16", "val_patch=16", "train_clips=2", "val_clips=1", "batch_size=2", "workers=0"]
    args = [*configs, *tiny, *(f"--data.{setting}" for setting in small), "-o", str(tmp_path)]
    main(["fit", *args, "--trainer.max_steps=1", "--trainer.log_every_n_steps=1"])
    main(["test", *args, "--ckpt_path", "last"])
    with open(tmp_path / "test.csv") as file:
        methods = {row["method"] for row in csv.DictReader(file)}
    takes_flow = getattr(networks, kind).takes_flow
    assert methods == {"TFI", "TFP", kind} | ({f"{kind}, true flow"} if takes_flow else set())

    main(["export", str(tmp_path / "checkpoints/last.ckpt"), "-o", str(tmp_path / "small.safetensors")])
    read = getattr(networks, kind).from_pretrained(tmp_path / "small.safetensors")
    assert read.settings == {
        name: value for name, value in read_weights(tmp_path / "small.safetensors").settings.items() if name != "class"
    }
    spikes = torch.rand(41, 10, 12, generator=torch.Generator().manual_seed(0)) < 0.3
    write_spikes(tmp_path / "clip.npz", spikes)
    weights = str(tmp_path / "small.safetensors")
    exact = ["--white", "0.4", "--precision", "32-true", "-o", str(tmp_path / "out")]
    main(["predict", str(tmp_path / "clip.npz"), "--weights", weights, *exact])
    [picture] = (tmp_path / "out").rglob("*.png")
    with torch.no_grad():
        expected = read(spikes[None])[0].clamp(0, 1)
    torch.testing.assert_close(read_picture(picture), expected, rtol=0, atol=0.51 / 255)


@pytest.mark.parametrize(
    ("config", "settings", "expected"),
    [
        ("x2.yaml", ["network=VidarSR", "network.frames=61"], "'frames': 61,.*'flow_times': (7, 53)"),
        (
            "quick.yaml",
            ["network.size=tiny", "network.stride=6", "network.frames=23"],
            "'frames': 23,.*'flow_times': (5, 17)",
        ),
        ("flow.yaml", ["window=21"], "'frames': 41,.*'flow_times': (10, 30)"),
    ],
)
def test_data_follow_frames_and_flow_times_of_the_network(config, settings, expected, tmp_path, monkeypatch):
    def stop(self, stage):
        raise ValueError(self.options)

    monkeypatch.setattr(StillScenes, "setup", stop)
    below = [] if config == "flow.yaml" else ["-c", str(CONFIGS / "x2.yaml")]
    settings = [f"--model.{setting}" for setting in settings]
    with pytest.raises(SystemExit, match=expected.replace("(", r"\(").replace(")", r"\)")):
        main(["test", *below, "-c", str(CONFIGS / config), *settings, "-o", str(tmp_path)])

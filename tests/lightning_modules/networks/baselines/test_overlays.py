"""The overlays of the baselines, as their users type them: trained, tested, exported, read again, and run."""

import csv
from pathlib import Path

import pytest
import torch
import yaml

from lightning_modules import networks
from lightning_modules.__main__ import main
from lightning_modules.pretrained import read_weights
from lightning_modules.sweep.paper import TABLE_2, method_of
from spikekit import read_picture, write_spikes

CONFIGS = Path(__file__).parents[4] / "configs"
OVERLAYS = sorted((CONFIGS / "baseline").glob("*.yaml"))

TINY = {
    "BasicVSR": {"width": 4, "blocks": 1, "neighbors": 1},
    "RealRawVSR": {"width": 8, "blocks": 2},
    "SpikeSRNetLike": {"width": 8, "maps": 2, "corrections": 1},
    "SwinIR": {"width": 6, "groups": 1, "layers": 2, "heads": 2},
    "TSCNN": {"width": 16, "blocks": 1, "low": 1, "high": 1},
    "VidarSR": {"width": 4, "features": 2},
}


def network(overlay):
    return yaml.safe_load(overlay.read_text())["model"]["network"]


@pytest.mark.parametrize("overlay", OVERLAYS, ids=lambda path: path.stem)
def test_what_an_overlay_says_is_all_that_its_network_has_in_common_with_cscsr(overlay):
    """It is laid over a configuration of CSCSR, whose settings of the same name would stay."""
    said = network(overlay)
    kind = getattr(networks, said["class_path"])
    for scale in (2, 3, 4):
        below = yaml.safe_load((CONFIGS / f"x{scale}.yaml").read_text())["model"]["network"]["init_args"]
        with torch.device("meta"):
            made = kind(scale=scale, **said["init_args"])
            assert method_of({"class": kind.__name__, **made.settings}) in TABLE_2[scale]
        stays = below.keys() & made.settings.keys() - said["init_args"].keys()
        assert stays <= {"scale", "frames", "pattern", "alpha"}


def test_every_method_of_the_paper_has_an_overlay():
    said = [network(overlay) for overlay in OVERLAYS]
    found = {method_of({"class": one["class_path"], **one["init_args"]}) for one in said}
    assert found == TABLE_2[4].keys() - {"CSCSR"}


@pytest.mark.slow
@pytest.mark.parametrize("overlay", OVERLAYS, ids=lambda path: path.stem)
def test_from_training_to_a_picture(overlay, tmp_path):
    kind = network(overlay)["class_path"]
    scale = 2 + OVERLAYS.index(overlay) % 3
    configs = ["-c", str(CONFIGS / f"x{scale}.yaml"), "-c", str(overlay)]
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
    recording = ["--data", "Recording", "--data.path", str(tmp_path / "clip.npz"), "--data.white", "0.4"]
    main(["predict", "--model.weights", str(tmp_path / "small.safetensors"), *recording, "-o", str(tmp_path / "out")])
    [picture] = (tmp_path / "out").rglob("*.png")
    with torch.no_grad():
        expected = read(spikes[None])[0].clamp(0, 1)
    torch.testing.assert_close(read_picture(picture), expected, rtol=0, atol=0.51 / 255)


def test_flow_between_other_frames_is_refused(tmp_path):
    """The data's is linked to CSCSR's window; of 41 frames it is that of all networks."""
    args = ["-c", str(CONFIGS / "x2.yaml"), "-c", str(CONFIGS / "baseline/vidarsr.yaml"), "-o", str(tmp_path)]
    with pytest.raises(
        SystemExit, match=r"data\.flow_times: expected \(7, 53\), between which the flow of VidarSR runs"
    ):
        main(["test", *args, "--model.network.frames=61"])

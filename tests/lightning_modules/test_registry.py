"""The registry of the weights in the package."""

import pytest

import lightning_modules
from lightning_modules.networks import CSCSR, RecurrentCSCSR
from lightning_modules.registry import find_model, list_models

MODELS = list_models()
NETWORKS = [model for model in MODELS if model.scale]


def test_weights_files_have_a_row_and_a_card_and_are_small():
    folder = MODELS[0].path.parent
    assert set(folder.glob("*.safetensors")) == {model.path for model in MODELS}
    assert {path.stem for path in folder.glob("*.md")} == {model.path.stem for model in MODELS}
    assert sum(path.stat().st_size for path in folder.glob("*.safetensors")) < 80e6  # what a wheel may hold


def test_models_are_selected_by_scale_and_pattern():
    assert lightning_modules.list_models() == MODELS
    assert [model for scale in (1, 2, 3, 4) for model in list_models(scale)] == NETWORKS
    assert list_models(4, "RGGB") == list_models(4)
    assert list_models(pattern="BGGR") == []
    assert find_model("cscsr_small_x4") == next(model for model in MODELS if model.name == "cscsr_small_x4")
    assert find_model("x4-e") is None


@pytest.mark.parametrize("model", NETWORKS, ids=lambda model: model.name)
def test_rows_agree_with_their_networks(model):
    network = CSCSR.from_pretrained(model.name)
    assert type(network) is (RecurrentCSCSR if model.film else CSCSR)
    assert (network.scale, network.frames, network.pattern) == (model.scale, model.frames, model.pattern)
    assert network.halo == model.margin
    assert model.parameters == sum(value.numel() for value in network.parameters())
    assert model.macs > 0
    assert model.pattern == "grey" or min(model.kodak, model.vid4) > 0

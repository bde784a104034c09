"""The constants of weights, in the file beside them."""

import json
import shutil

import pytest

from lightning_modules.networks import CSCSR
from lightning_modules.registry import list_models
from lightning_modules.storage.error_model import FILE, ErrorModel, read_error_model, write_error_model


def test_all_weights_of_the_package_have_their_own():
    files = {model.path for model in list_models() if model.scale and model.pattern != "grey"}
    assert set(json.loads(next(iter(files)).with_name(FILE).read_text())) == {path.name for path in files}
    models = [read_error_model(path) for path in files]
    assert len(set(models)) == len(models)
    careful = ErrorModel()  # the defaults spend no less than any of them
    for model in models:
        assert model.still <= careful.still
        assert all(getattr(model, name) >= getattr(careful, name) for name in ("textured", "moved", "faint"))


def test_a_network_has_the_constants_of_its_weights(tmp_path):
    file = tmp_path / "mine.safetensors"
    shutil.copy(list_models(4)[0].path, file)
    assert CSCSR.from_pretrained(file).error_model == ErrorModel()
    model = ErrorModel(still=1.0, faint=0.0)
    assert write_error_model(file, model) == tmp_path / FILE
    write_error_model(tmp_path / "other.safetensors", ErrorModel(still=9.0))
    assert CSCSR.from_pretrained(file).error_model == model
    assert read_error_model(tmp_path / "third.safetensors") == ErrorModel()
    assert read_error_model(tmp_path / "mine.ckpt") == ErrorModel()


def test_constants_of_a_checkpoint_are_not_written(tmp_path):
    with pytest.raises(ValueError, match=r"best\.ckpt: expected a file of safetensors"):
        write_error_model(tmp_path / "best.ckpt", ErrorModel())

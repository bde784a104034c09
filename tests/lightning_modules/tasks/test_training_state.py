import pytest

from lightning_modules.tasks.training_state import restoring


@pytest.mark.parametrize("error", [RuntimeError("sizes differ"), KeyError("a"), AttributeError("none")])
def test_errors_are_of_the_checkpoint_until_it_is_restored(error):
    with (
        pytest.raises(ValueError, match=r"^last.ckpt: not a checkpoint that fits") as named,
        restoring("last.ckpt", []),
    ):
        raise error
    assert named.value.__cause__ is error
    for path, begun in (("last.ckpt", [True]), (None, [])):
        with pytest.raises(type(error)) as itself, restoring(path, begun):
            raise error
        assert itself.value is error

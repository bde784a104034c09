"""Constructors that take the arguments of another class."""

from inspect import Parameter, signature

import pytest

from lightning_modules.data import FilmScenes, StillClips, StillScenes
from lightning_modules.data.sequences import ClipRecipe
from lightning_modules.signatures import inherit_signature


class Inner:
    """What is inside.

    Args:
        size: its size.
    """

    def __init__(self, size: "int", colour: str = "red", hidden: bool = False) -> None:
        pass


def test_its_own_first_then_by_name_what_is_passed_on():
    class Outer:
        @inherit_signature(Inner, "hidden")
        def __init__(self, root: "str", *, colour: int = 3, **settings: object) -> None:
            pass

    parameters = signature(Outer).parameters
    assert list(parameters) == ["root", "size", "colour"]
    assert parameters["size"].kind is Parameter.KEYWORD_ONLY
    assert [(one.annotation, one.default) for one in parameters.values()][1:] == [(int, Parameter.empty), (int, 3)]
    assert Outer.__init__.__doc__ == Inner.__doc__


@pytest.mark.parametrize(
    ("scenes", "clips", "without", "first"),
    [
        (StillScenes, StillClips, {"pictures", "augment", "textures", "length"}, ["root", "val_root"]),
        (FilmScenes, ClipRecipe, set(), ["root"]),
    ],
)
def test_data_take_the_arguments_of_their_clips(scenes, clips, without, first):
    here, there = signature(scenes).parameters, signature(clips).parameters
    assert there.keys() - here.keys() == without
    assert list(here)[: len(first)] == first

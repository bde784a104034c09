"""Constructors that accept the arguments of another class."""

from inspect import signature

import pytest

from lightning_modules.data import FilmScenes, StillClips, StillScenes
from lightning_modules.data.sequences import ClipRecipe


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

"""One list of what a CSCSR is made of: the constructor, the command line, weights and checks read it."""

from dataclasses import FrozenInstanceError, asdict, fields
from inspect import signature

import pytest
import torch
from jsonargparse import ArgumentParser

from lightning_modules.networks import CSCSR, CSCSRConfig

NAMES = [field.name for field in fields(CSCSRConfig)]
TINY = {"width": 4, "representation_width": 4, "features": 1, "stages": 1, "end_blocks": 1}


def test_the_constructor_takes_the_fields_and_what_weights_serve_with_any_of():
    parameters = signature(CSCSR).parameters
    assert list(parameters) == [*NAMES, "steps", "motion"]
    assert {name: parameters[name].default for name in NAMES} == asdict(CSCSRConfig())
    network = CSCSR(2, 23, **TINY)
    assert network.config == CSCSRConfig(scale=2, frames=23, **TINY)
    assert network.settings == asdict(network.config)
    with pytest.raises(TypeError, match="widht"):
        CSCSR(widht=4)
    with pytest.raises(FrozenInstanceError):
        network.config.scale = 3


def test_the_command_line_takes_the_fields_and_says_what_they_are():
    parser = ArgumentParser(exit_on_error=False)
    parser.add_subclass_arguments(CSCSR, "network")
    typed = [f"--network.{name}={value}" for name, value in {**TINY, "pattern": "BGGR", "alpha": 0.5}.items()]
    config = parser.parse_args(["--network=CSCSR", "--network.end_width=null", "--network.skip=true", *typed])
    network = parser.instantiate(config).network
    assert network.config == CSCSRConfig(**TINY, pattern="BGGR", alpha=0.5, skip=True)
    with pytest.raises(Exception, match="representation"):
        parser.parse_args(["--network=CSCSR", "--network.representation=mean"])
    parser = ArgumentParser()
    parser.add_class_arguments(CSCSR, "network")
    text = " ".join(parser.format_help().split())
    for name in NAMES:
        described = CSCSRConfig.__doc__.partition(f"        {name}: ")[2].splitlines()[0]
        assert f"--network.{name} " in text
        assert " ".join(described.split()[:4]) in text


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"skip": 1}, "skip: expected true or false, got 1"),
        ({"search": "no"}, "search: expected true or false, got 'no'"),
        ({"frames": True}, "frames: expected a whole number >= 1, got True"),
        ({"end_width": 1.5}, "end_width: expected a whole number >= 1, got 1.5"),
        ({"alpha": -1.0}, "alpha: expected a finite number above 0, got -1.0"),
        ({"pattern": "RGB"}, "pattern: expected one of"),
        ({"resolution": "view"}, "resolution: expected one of output, sensor, got 'view'"),
    ],
)
def test_every_field_is_checked_by_its_type(changed, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        CSCSRConfig(**changed)


def test_settings_are_plain_values_whatever_came():
    config = CSCSRConfig(width=torch.tensor(8))
    assert type(config.width) is int
    assert {type(value) for value in asdict(config).values()} <= {int, float, bool, str, type(None)}

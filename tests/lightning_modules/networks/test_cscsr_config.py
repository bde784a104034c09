"""CSCSRConfig, the one list of options for the constructor, the command line and weights."""

from dataclasses import FrozenInstanceError, asdict, fields
from inspect import signature

import pytest
import torch
from jsonargparse import ArgumentParser

from lightning_modules.networks import CSCSR, CSCSRConfig
from lightning_modules.networks.sizes import SIZES

NAMES = [field.name for field in fields(CSCSRConfig)]
TINY = {"width": 4, "representation_width": 4, "features": 1, "stages": 1, "end_blocks": 1}


def test_constructor_takes_all_fields_and_motion():
    parameters = signature(CSCSR).parameters
    assert list(parameters) == [*NAMES, "motion"]
    assert {name: parameters[name].default for name in NAMES} == {one.name: one.default for one in fields(CSCSRConfig)}
    network = CSCSR(2, 23, **TINY)
    assert network.config == CSCSRConfig(scale=2, frames=23, **TINY)
    assert network.settings == network.config.settings
    assert CSCSR(**network.settings).config.settings == network.settings  # files do not store the size
    with pytest.raises(TypeError, match="widht"):
        CSCSR(widht=4)
    with pytest.raises(FrozenInstanceError):
        network.config.scale = 3


def test_command_line_takes_all_fields_and_documents_them():
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
        ({"end_width": 1.5}, "end_width: expected a whole number >= 1, got 1.5"),
        ({"alpha": float("nan")}, "alpha: expected a finite number above 0, got nan"),
        ({"pattern": "RGB"}, "pattern: expected one of"),
        ({"resolution": "view"}, "resolution: expected one of output, sensor, cell, got 'view'"),
        ({"size": "gigantic"}, "size: expected one of nano, micro, tiny, "),
        ({"frames": 40}, "frames, window, stride: expected odd frames"),
        ({"stride": 7}, "frames, window, stride: .* divides frames - window"),
        ({"representation": "tfp"}, "representation: expected one of bssr, spikes, interval, got 'tfp'"),
        ({"representation": "spikes", "global_perception": False}, "global_perception: expected true"),
        ({"motion_fusion": "independent", "search": False}, "motion_fusion: expected joint, .* without search"),
        ({"end_width": 8, "reconstruction": "separate"}, "end_width: expected None"),
        ({"noise": True, "representation": "spikes"}, "noise: expected representation bssr"),
        ({"resolution": "cell", "reconstruction": "early"}, "representation, reconstruction, noise_blocks: .* cell"),
        ({"pattern": "grey", "motion_fusion": "assembled"}, "motion_fusion, reconstruction: .* grey"),
        ({"pattern": "grey", "reconstruction": "early"}, "motion_fusion, reconstruction: .* grey"),
    ],
)
def test_invalid_fields_are_rejected(changed, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        CSCSRConfig(**changed)


@pytest.mark.parametrize("size", SIZES)
def test_size_sets_the_missing_fields(size):
    config, other = CSCSRConfig(size=size), CSCSRConfig(size=size, width=8, stride=15)
    assert SIZES[size].items() <= config.settings.items()
    assert (other.width, other.stride, other.end_blocks) == (8, 15, config.end_blocks)
    assert None not in {value for name, value in config.settings.items() if name not in ("end_width", "noise_blocks")}
    assert CSCSRConfig(**config.settings).settings == config.settings


@pytest.mark.parametrize(("frames", "points"), [(101, 11), (53, 15), (13, 3)])
def test_default_stride_divides_the_clip(frames, points):
    times = CSCSRConfig(frames=frames).times
    assert len(times) == points
    assert times[0] + times[-1] == frames - 1


def test_settings_are_plain_values():
    config = CSCSRConfig(width=torch.tensor(8))
    assert type(config.width) is int
    assert {type(value) for value in asdict(config).values()} <= {int, float, bool, str, type(None)}

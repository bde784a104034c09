"""Stands between two rooms that are being rebuilt: models and recordings as they will be called."""

from argparse import Namespace
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lightning_modules.storage.shipped import list_pretrained
from spikekit.io import recording


@dataclass(frozen=True)
class Model:
    """A row of the registry of models."""

    name: str
    scale: int | None
    size: str | None
    frames: int | None
    pattern: str
    margin: int | None
    film: bool
    noise: bool
    macs: int | None


def list_models(scale: int | None = None, pattern: str | None = None) -> list[Model]:
    """List the weights of the package."""
    return [
        Model(one.name, one.scale, one.size, one.frames, "RGGB", one.halo, one.film, "noisy" in one.name, one.macs)
        for one in list_pretrained(scale)
    ]


def find_model(name: str) -> Model | None:
    """Find weights by their name."""
    return next((one for one in list_models() if one.name == name), None)


def open_recording(path: str | Path, *, pattern: str | None = None, **known: Any) -> recording.Recording:
    """Open a recording."""
    said = None if pattern == "grey" else pattern
    known = {**dict.fromkeys(("height", "width", "camera", "calibration")), "flip": False, **known}
    found = recording.open_recording(Namespace(file=Path(path), pattern=said, **known))
    return replace(found, pattern="grey") if pattern == "grey" else found

"""Stands between two rooms that are being rebuilt: models as they will be called."""

from dataclasses import dataclass

from lightning_modules.storage.shipped import list_pretrained


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

"""Weights in files: those that come with the package, those of safetensors, and checkpoints of ``lightning fit``."""

from __future__ import annotations

import json
from dataclasses import dataclass
from inspect import signature
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

_FOLDER = Path(__file__).parent / "weights"
_MOTION = "motion."


class CheckpointMismatchError(ValueError):
    """Weights of another network than the one that they are meant for."""


@dataclass(frozen=True)
class Weights:
    """What a file holds.

    Args:
        source: the file.
        settings: class of the network, as ``"class"``, and the arguments that it was built with; empty where the file
            does not say.
        motion: likewise of the learned estimator of motion inside the network, empty where it has none, or where the
            file does not say.
        tensors: weights by name.
    """

    source: Path
    settings: dict[str, Any]
    motion: dict[str, Any]
    tensors: dict[str, Tensor]


def shipped_weights() -> dict[str, Path]:
    """Return the files of weights that come with the package, by name."""
    return {path.stem: path for path in sorted(_FOLDER.glob("*.safetensors"))}


def read_weights(source: str | Path) -> Weights:
    """Read weights; nothing in the file is run.

    Args:
        source: the name of weights that come with the package, such as ``"x4-e"``; a file of safetensors; or a
            checkpoint of ``lightning fit``.

    Raises:
        FileNotFoundError: neither a file nor the name of one.
        ValueError: a file that is damaged, or of something else.
    """
    shipped = shipped_weights()
    path = shipped.get(str(source), Path(source))
    if not path.is_file():
        names = ", ".join(shipped) or "none"
        raise FileNotFoundError(f"{source}: neither a file of weights nor the name of those in the package ({names})")
    return _read_safetensors(path) if path.suffix == ".safetensors" else _read_checkpoint(path)


def _read_safetensors(path: Path) -> Weights:
    try:
        with safe_open(path, "pt") as file:
            said = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: not a file of safetensors, or a damaged one ({_first_line(error)})") from error
    try:
        settings, motion = json.loads(said["network"]), json.loads(said["motion"])
        return Weights(path, {"class": settings["class"], **_named(settings)}, _named(motion), tensors)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: does not say what network it is of, as lightning export would") from error


def _read_checkpoint(path: Path) -> Weights:
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        settings, motion = _named(checkpoint["network"]), _named(checkpoint.get("motion", {}))
        tensors = {name.removeprefix("network."): value for name, value in checkpoint["state_dict"].items()}
        if not all(isinstance(value, Tensor) for value in tensors.values()):
            raise TypeError("state_dict: expected tensors")
    except Exception as error:
        reason = f"{type(error).__name__}: {_first_line(error)}"
        raise ValueError(f"{path}: not a checkpoint of lightning fit ({reason})") from error
    return Weights(path, settings, motion, tensors)


def _named(settings: dict[str, Any]) -> dict[str, Any]:
    """Return settings whose class is a name: a path would be imported, and so run, when the network is built."""
    settings = dict(settings)
    if not str(settings.get("class", "none")).isidentifier():
        raise ValueError(f"class: expected a name, got {settings['class']!r}")
    json.dumps(settings)  # plain values
    return settings


def write_weights(weights: Weights, path: str | Path) -> None:
    """Write weights as a file of safetensors that knows what network it is of.

    Raises:
        ValueError: the name does not end in .safetensors.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise ValueError(f"{path}: expected a name that ends in .safetensors")
    path.parent.mkdir(parents=True, exist_ok=True)
    # copies, as tensors that share memory cannot be saved
    tensors = {name: value.clone(memory_format=torch.contiguous_format) for name, value in weights.tensors.items()}
    # save_file leaves a file that nobody else may read
    path.write_bytes(save(tensors, {"network": json.dumps(weights.settings), "motion": json.dumps(weights.motion)}))


def settings_of(network: nn.Module) -> dict[str, Any]:
    """Return the class of a network and what it was built with."""
    return {"class": type(network).__name__, **network.settings}


def motion_of(network: nn.Module) -> dict[str, Any]:
    """Return the same of the estimator of motion in a network, if it has one with weights."""
    motion = getattr(network, "motion", None)
    learned = motion is not None and bool(motion.state_dict())
    return settings_of(motion) if learned else {}


def check_settings(network: nn.Module, settings: dict[str, Any], source: str | Path) -> None:
    """Refuse weights of another network: scale, say, is in no parameter, and would go unnoticed.

    Args:
        network: what the weights are meant for.
        settings: class and arguments of the network that they are of; empty where they are not known.
        source: what the weights are called.

    Raises:
        CheckpointMismatchError: there are differences; the message names them.
    """
    here = settings_of(network)
    # an argument that is younger than the weights had the effect of its default
    defaults = {name: parameter.default for name, parameter in signature(type(network)).parameters.items()}
    there = {**defaults, **(settings or here)}
    differing = [key for key in here if here[key] != there.get(key)]
    if differing:
        trained = ", ".join(f"{key}={there.get(key)}" for key in differing)
        asked = ", ".join(f"{key}={here[key]}" for key in differing)
        raise CheckpointMismatchError(f"{source} was trained with {trained}; this run asks for {asked}")


def with_own_motion(
    tensors: dict[str, Tensor], motion: nn.Module, prefix: str = "", keep: bool = False
) -> dict[str, Tensor]:
    """Weights in which those of another kind of estimator are replaced by an estimator's own.

    Estimators are exchanged freely: a network is trained with one and used with all of them.

    Args:
        tensors: weights of a network, by name.
        motion: the estimator of the network that they are meant for.
        prefix: what the names begin with.
        keep: replace those of the same kind as well.
    """
    prefix += _MOTION
    ours = {f"{prefix}{name}": value for name, value in motion.state_dict().items()}
    theirs = {name: value for name, value in tensors.items() if name.startswith(prefix)}
    shapes = [{name: value.shape for name, value in weights.items()} for weights in (ours, theirs)]
    if shapes[0] == shapes[1] and not keep:
        return tensors
    return {name: tensors[name] for name in tensors.keys() - theirs.keys()} | ours


def load_weights(network: nn.Module, weights: Weights, keep_motion: bool = False) -> None:
    """Give a network weights that are of its kind.

    Args:
        network: what the weights are meant for.
        weights: they.
        keep_motion: leave its estimator of motion as it is, also where the weights have one of the same kind.

    Raises:
        CheckpointMismatchError: they are of another network.
        ValueError: the file says that they fit, and they do not.
    """
    check_settings(network, weights.settings, weights.source)
    motion = getattr(network, "motion", None)
    tensors = weights.tensors if motion is None else with_own_motion(weights.tensors, motion, keep=keep_motion)
    try:
        network.load_state_dict(tensors)
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise ValueError(f"{weights.source}: weights that do not fit ({reason})") from error


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [""])[0]

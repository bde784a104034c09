"""Reading and writing of weights: those in the package, safetensors, and checkpoints of ``lightning fit``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from inspect import signature
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from lightning_modules.registry import find_model, list_models
from lightning_modules.storage.checkpoint import check_tensors, read_checkpoint
from lightning_modules.storage.settings import check_plain, check_shapes, load_state
from spikekit.arguments import one_line
from spikekit.io.whole_file import write_whole

_MOTION = "motion."
_COMPILED = "_orig_mod."  # prefix of parameter names after torch.compile
_ADAPTED = "alpha", "motion_fusion"  # settings that may differ from those of the weights


class CheckpointMismatchError(ValueError):
    """The weights belong to a different network."""


@dataclass(frozen=True)
class Weights:
    """Contents of a weights file.

    Args:
        source: path of the file.
        settings: class of the network, as ``"class"``, and arguments of its constructor; empty if the file does not
            store them.
        motion: class and arguments of the learned motion estimator inside the network; empty if there is none, or if
            the file does not store them.
        tensors: weights by name.
        halo: radius of the receptive field in sensor pixels, if measured.
    """

    source: Path
    settings: dict[str, Any]
    motion: dict[str, Any]
    tensors: dict[str, Tensor]
    halo: int | None = None


def read_weights(source: str | Path) -> Weights:
    """Read weights without executing code in the file.

    Args:
        source: name of weights in the package, such as ``"cscsr_small_x4"``; path of a safetensors file; or checkpoint
            of ``lightning fit``.
    """
    model = find_model(str(source))
    path = model.path if model else Path(source)
    if not path.is_file():
        if len(path.parts) > 1 or path.suffix in (".ckpt", ".safetensors"):
            raise FileNotFoundError(f"{source}: no such file of weights")
        names = ", ".join(model.name for model in list_models())
        raise FileNotFoundError(f"{source}: expected a file of weights or a name in the package ({names})")
    found = _read_safetensors(path) if path.suffix == ".safetensors" else _read_checkpoint(path)
    return replace(found, halo=model.margin) if model else found


def check_weights(weights: Weights, kinds: Mapping[str, type[nn.Module]]) -> None:
    """Check that weights fit the network and estimator that their file names, without allocating memory for them.

    ``kinds`` are the classes of this package by name; weights of other classes are checked when they are loaded.
    """
    inside = {name.removeprefix(_MOTION): value for name, value in weights.tensors.items() if name.startswith(_MOTION)}
    outside = {name: value for name, value in weights.tensors.items() if not name.startswith(_MOTION)}
    for settings, tensors in ((weights.settings, outside), (weights.motion, inside)):
        if settings.get("class") in kinds:
            check_shapes(settings, tensors, weights.source, kinds)


def _read_safetensors(path: Path) -> Weights:
    try:
        with safe_open(path, "pt") as file:
            said = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        check_tensors(tensors)
    except (SafetensorError, OSError, AttributeError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: not a safetensors file, or damaged ({one_line(error)[:300]})") from error
    try:
        settings, motion = json.loads(said["network"]), json.loads(said["motion"])
        return Weights(path, {"class": settings["class"], **_named(settings)}, _named(motion), tensors)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected metadata of the network, as written by lightning export") from error


def _read_checkpoint(path: Path) -> Weights:
    checkpoint = read_checkpoint(path)
    tensors = {
        name.removeprefix("network.").removeprefix(_COMPILED): value for name, value in checkpoint["state_dict"].items()
    }
    network = checkpoint["network"]
    try:
        return Weights(path, {"class": network["class"], **_named(network)}, _named(checkpoint["motion"]), tensors)
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path}: not a checkpoint of lightning fit ({error})") from error


def _named(settings: dict[str, Any]) -> dict[str, Any]:
    """Check that settings are plain values and that their class is a plain name, and return a copy."""
    settings = dict(settings)
    check_plain("settings", settings)
    if not str(settings.get("class", "none")).isidentifier():
        raise ValueError(f"class: expected the name of a class, got {settings['class']!r}")
    return settings


def write_weights(weights: Weights, path: str | Path) -> None:
    """Write a safetensors file of weights and the settings of their network."""
    path = Path(path)
    if path.suffix != ".safetensors":
        raise ValueError(f"{path}: expected a name that ends in .safetensors")
    # copied, as safetensors rejects tensors that share memory
    tensors = {
        name.removeprefix(_COMPILED): value.clone(memory_format=torch.contiguous_format)
        for name, value in weights.tensors.items()
    }
    said = {"network": json.dumps(weights.settings), "motion": json.dumps(weights.motion)}
    write_whole(path, _same_every_time(save(tensors, said)))


def _same_every_time(data: bytes) -> bytes:
    """Sort the metadata of a safetensors file, whose order is random."""
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    return data[:8] + json.dumps(header, separators=(",", ":")).encode().ljust(length) + data[8 + length :]


def settings_of(network: nn.Module) -> dict[str, Any]:
    """Return the class of a network, which may be compiled, and its ``settings``, if it has any."""
    network = getattr(network, "_orig_mod", network)
    return {"class": type(network).__name__, **getattr(network, "settings", {})}


def motion_of(network: nn.Module) -> dict[str, Any]:
    """Return class and settings of a network's motion estimator; empty if it has no weights."""
    motion = getattr(network, "motion", None)
    learned = motion is not None and bool(motion.state_dict())
    return settings_of(motion) if learned else {}


def check_settings(network: nn.Module, settings: dict[str, Any], source: str | Path) -> None:
    """Check that a network has the settings stored with weights, as parameters alone would not show another scale.

    Empty settings, of files that store none, are accepted.
    """
    here = settings_of(network)
    # arguments added after the weights were written have their default values
    defaults = {name: parameter.default for name, parameter in signature(type(network)).parameters.items()}
    there = {**defaults, **(settings or here)}
    differing = [key for key in here if here[key] != there.get(key)]
    if differing:
        trained = ", ".join(f"{key}={there.get(key)}" for key in differing)
        asked = ", ".join(f"{key}={here[key]}" for key in differing)
        way = "; --model.weights adapts them" if set(differing) <= set(_ADAPTED) else ""
        raise CheckpointMismatchError(f"{source} was trained with {trained}; this run asks for {asked}{way}")


def with_own_motion(
    tensors: dict[str, Tensor], motion: nn.Module, prefix: str = "", keep: bool = False
) -> dict[str, Tensor]:
    """Replace the motion estimator's weights in ``tensors`` by those of ``motion``, unless both have the same shapes.

    A network trained with one estimator can be used with any other. With ``keep``, weights of the same shapes are
    replaced as well.
    """
    prefix += _MOTION
    ours = {f"{prefix}{name}": value for name, value in motion.state_dict().items()}
    theirs = {name: value for name, value in tensors.items() if name.startswith(prefix)}
    shapes = [{name: value.shape for name, value in weights.items()} for weights in (ours, theirs)]
    if shapes[0] == shapes[1] and not keep:
        return tensors
    return {name: tensors[name] for name in tensors.keys() - theirs.keys()} | ours


def load_weights(network: nn.Module, weights: Weights, keep_motion: bool = False) -> None:
    """Load weights into a network of the same class and settings.

    The settings ``alpha`` and ``motion_fusion`` may differ. If alpha differs, the network's output is scaled by the
    ratio of the gains. A network with ``noise`` may start from weights without: it ignores the noise level until it is
    trained. With ``keep_motion``, the network keeps the weights of its own motion estimator.
    """
    network = getattr(network, "_orig_mod", network)
    exchanged = {name: network.settings[name] for name in _ADAPTED if name in network.settings}
    ratio = weights.settings.get("alpha", exchanged["alpha"]) / exchanged["alpha"] if "alpha" in exchanged else 1
    if network.settings.get("noise") and not weights.settings.get("noise"):
        exchanged |= {name: network.settings[name] for name in ("noise", "noise_blocks")}
        weights = replace(weights, tensors={**network.state_dict(), **weights.tensors})
    check_settings(network, weights.settings and {**weights.settings, **exchanged}, weights.source)
    motion = getattr(network, "motion", None)
    tensors = weights.tensors if motion is None else with_own_motion(weights.tensors, motion, keep=keep_motion)
    load_state(network, tensors, weights.source)
    if ratio != 1:
        network.scale_picture(ratio)
    if weights.halo is not None:
        network.halo = weights.halo

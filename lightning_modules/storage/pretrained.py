"""Files of weights: shipped ones, safetensors, and checkpoints of ``lightning fit``."""

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

from lightning_modules.registry import FUSION, find_model, list_models
from lightning_modules.storage.checkpoint import check_tensors, read_checkpoint
from lightning_modules.storage.settings import check_plain, check_shapes, load_state
from spikekit.arguments import one_line
from spikekit.io.whole_file import whole_file

_MOTION = "motion."
_COMPILED = "_orig_mod."  # how the names of a network begin that torch.compile returned
_ADAPTED = "alpha", "motion_fusion"  # settings that weights serve any value of


class CheckpointMismatchError(ValueError):
    """Weights of a different network than the one they are meant for."""


@dataclass(frozen=True)
class Weights:
    """The contents of a file of weights.

    Args:
        source: the file.
        settings: class of the network, as ``"class"``, and the arguments that it was built with; empty where the file
            does not say.
        motion: likewise of the learned estimator of motion inside the network, empty where it has none, or where the
            file does not say.
        tensors: weights by name.
        halo: how far the network sees with them, where that was measured.
    """

    source: Path
    settings: dict[str, Any]
    motion: dict[str, Any]
    tensors: dict[str, Tensor]
    halo: int | None = None


def read_weights(source: str | Path) -> Weights:
    """Read weights; nothing in the file is run.

    Args:
        source: the name of weights that come with the package, such as ``"cscsr_small_x4"``; a file of safetensors; or
            a checkpoint of ``lightning fit``.

    Raises:
        FileNotFoundError: neither a file nor the name of one.
        ValueError: a file that is damaged or of something else, weights that are not finite, or settings that this
            package cannot have written or that do not fit the weights; the message is one line and names the file.
    """
    model = find_model(str(source))
    path = model.path if model else Path(source)
    if not path.is_file():
        names = ", ".join(model.name for model in list_models())
        raise FileNotFoundError(f"{source}: neither a file of weights nor the name of those in the package ({names})")
    found = _read_safetensors(path) if path.suffix == ".safetensors" else _read_checkpoint(path)
    if model and not model.film and found.settings["class"] == "RecurrentCSCSR":
        found = _of_a_clip(found)
    return replace(found, halo=model.margin) if model else found


def _of_a_clip(weights: Weights) -> Weights:
    """Return the weights of the CSCSR that a network for films contains, which came first and shares its file."""
    added = ("fusion_width", "fusion_blocks", "memory")
    settings = {name: value for name, value in weights.settings.items() if name not in added} | {"class": "CSCSR"}
    tensors = {name: value for name, value in weights.tensors.items() if not name.startswith(FUSION)}
    return replace(weights, settings=settings, tensors=tensors)


def check_weights(weights: Weights, kinds: Mapping[str, type[nn.Module]]) -> None:
    """Compare weights with the network that their file names, before anything is built or takes memory.

    Args:
        weights: as they were read.
        kinds: networks and estimators of this package, by name; weights of others are compared when they are loaded.

    Raises:
        ValueError: as :func:`lightning_modules.storage.settings.check_shapes`.
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
        raise ValueError(f"{path}: not a file of safetensors, or a damaged one ({one_line(error)[:300]})") from error
    try:
        settings, motion = json.loads(said["network"]), json.loads(said["motion"])
        return Weights(path, {"class": settings["class"], **_named(settings)}, _named(motion), tensors)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: does not say what network it is of, as lightning export would") from error


def _read_checkpoint(path: Path) -> Weights:
    checkpoint = read_checkpoint(path)
    tensors = {
        name.removeprefix("network.").removeprefix(_COMPILED): value for name, value in checkpoint["state_dict"].items()
    }
    try:
        return Weights(path, _named(checkpoint["network"]), _named(checkpoint["motion"]), tensors)
    except ValueError as error:
        raise ValueError(f"{path}: not a checkpoint of lightning fit ({error})") from error


def _named(settings: dict[str, Any]) -> dict[str, Any]:
    """Return settings that are plain, and whose class is a name and no path."""
    settings = dict(settings)
    check_plain("settings", settings)
    if not str(settings.get("class", "none")).isidentifier():
        raise ValueError(f"class: expected a name, got {settings['class']!r}")
    return settings


def write_weights(weights: Weights, path: str | Path) -> None:
    """Write weights as a safetensors file that also stores which network they belong to.

    Raises:
        ValueError: the name does not end in .safetensors.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise ValueError(f"{path}: expected a name that ends in .safetensors")
    # copies, as tensors that share memory cannot be saved
    tensors = {
        name.removeprefix(_COMPILED): value.clone(memory_format=torch.contiguous_format)
        for name, value in weights.tensors.items()
    }
    said = {"network": json.dumps(weights.settings), "motion": json.dumps(weights.motion)}
    with whole_file(path) as file:
        file.write(_same_every_time(save(tensors, said)))


def _same_every_time(data: bytes) -> bytes:
    """Sort the metadata of a safetensors file, which its writer shuffles."""
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    return data[:8] + json.dumps(header, separators=(",", ":")).encode().ljust(length) + data[8 + length :]


def settings_of(network: nn.Module) -> dict[str, Any]:
    """Return the class of a network, which may be compiled, and its arguments; none of one that does not say."""
    network = getattr(network, "_orig_mod", network)
    return {"class": type(network).__name__, **getattr(network, "settings", {})}


def motion_of(network: nn.Module) -> dict[str, Any]:
    """Return the same for the motion estimator of a network, if it has one with weights."""
    motion = getattr(network, "motion", None)
    learned = motion is not None and bool(motion.state_dict())
    return settings_of(motion) if learned else {}


def check_settings(network: nn.Module, settings: dict[str, Any], source: str | Path) -> None:
    """Refuse weights of another network: a different scale, for example, changes no parameter and would go unnoticed.

    Empty settings are those of weights that do not say what they are of.

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
        way = "; --model.weights adapts them" if set(differing) <= set(_ADAPTED) else ""
        raise CheckpointMismatchError(f"{source} was trained with {trained}; this run asks for {asked}{way}")


def with_own_motion(
    tensors: dict[str, Tensor], motion: nn.Module, prefix: str = "", keep: bool = False
) -> dict[str, Tensor]:
    """Replace the weights of another kind of estimator by an estimator's own.

    Estimators are exchanged freely: a network is trained with one and used with all of them. Those of the same kind
    are replaced as well where the network is to ``keep`` its own.
    """
    prefix += _MOTION
    ours = {f"{prefix}{name}": value for name, value in motion.state_dict().items()}
    theirs = {name: value for name, value in tensors.items() if name.startswith(prefix)}
    shapes = [{name: value.shape for name, value in weights.items()} for weights in (ours, theirs)]
    if shapes[0] == shapes[1] and not keep:
        return tensors
    return {name: tensors[name] for name in tensors.keys() - theirs.keys()} | ours


def load_weights(network: nn.Module, weights: Weights, keep_motion: bool = False) -> None:
    """Load weights into a network of the same kind.

    Weights belong to the gain alpha that they were trained with. If the network was built for another, its picture is
    multiplied by the ratio of the gains. How the motion of the colours is joined may differ as well: it has no weights.
    The network may keep its estimator of motion where the weights have one of the same kind.

    Raises:
        CheckpointMismatchError: they are of another network.
        ValueError: the file says that they fit, and they do not.
    """
    network = getattr(network, "_orig_mod", network)
    exchanged = {name: network.settings[name] for name in _ADAPTED if name in network.settings}
    ratio = weights.settings.get("alpha", exchanged["alpha"]) / exchanged["alpha"] if "alpha" in exchanged else 1
    check_settings(network, weights.settings and {**weights.settings, **exchanged}, weights.source)
    motion = getattr(network, "motion", None)
    tensors = weights.tensors if motion is None else with_own_motion(weights.tensors, motion, keep=keep_motion)
    load_state(network, tensors, weights.source)
    if ratio != 1:
        network.scale_picture(ratio)
    if weights.halo is not None:
        network.halo = weights.halo

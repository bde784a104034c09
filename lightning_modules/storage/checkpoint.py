"""Safe reading of checkpoints of ``lightning fit``."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lightning_modules.storage.settings import check_plain
from spikekit.arguments import one_line

_NUMBERS = {torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.int64, torch.int32, torch.bool}
_KINDS = {
    **dict.fromkeys(("network", "motion", "recipe", "callbacks", "loops"), dict),
    **dict.fromkeys(("optimizer_states", "lr_schedulers"), list),
    **dict.fromkeys(("epoch", "global_step"), int),
}
#: keys from which Lightning would build objects
_NOT_TAKEN = ("hyper_parameters", "datamodule_hyper_parameters", "hparams_name", "datamodule_hparams_name")


class DivergedError(ValueError):
    """The weights of a training are no longer finite."""


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint, without hyper-parameters, to the CPU; no code of it is executed, none of its classes is built.

    It holds finite weights as ``state_dict``, and ``network``, ``motion`` and ``recipe`` as plain values.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such checkpoint")
    try:
        with zipfile.ZipFile(path) as archive:
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise ValueError("expected no compression, got a compressed file")  # a few bytes could fill all memory
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(checkpoint, dict) or not isinstance(checkpoint.get("state_dict"), dict):
            raise TypeError("expected a dictionary with a state_dict")
        for key, kind in _KINDS.items():
            if not isinstance(checkpoint.get(key, kind()), kind):
                raise TypeError(f"{key}: expected a {kind.__name__}, got a {type(checkpoint[key]).__name__}")
        for key in ("network", "motion", "recipe"):  # older checkpoints have no recipe
            check_plain(key, checkpoint.setdefault(key, {}))
        check_tensors(checkpoint["state_dict"])
    except Exception as error:  # the type depends on the damage
        reason = one_line(error)[:300]
        if isinstance(error, pickle.UnpicklingError):  # torch's message would recommend unsafe loading
            reason = "expected tensors and plain values, got other objects, which are not loaded"
        raise ValueError(f"{path}: not a checkpoint of lightning fit ({type(error).__name__}: {reason})") from error
    return {key: value for key, value in checkpoint.items() if key not in _NOT_TAKEN}


def check_tensors(tensors: Mapping[str, Tensor]) -> None:
    """Check that weights are dense tensors and finite, as a network would otherwise return black pictures."""
    for name, value in tensors.items():
        if not isinstance(name, str) or not isinstance(value, Tensor):
            raise TypeError(
                f"state_dict: expected tensors by name, got a {type(value).__name__} for {str(name)[:80]!r}"
            )
        if value.layout is not torch.strided or value.is_meta or value.dtype not in _NUMBERS:
            raise TypeError(f"{name}: expected a dense tensor of numbers, got {value.dtype}, {value.layout}")
        if value.numel() * value.element_size() > value.untyped_storage().nbytes():
            raise TypeError(f"{name}: expected data for shape {tuple(value.shape)}, got a shorter storage")
        if not value.isfinite().all():
            raise ValueError(f"{name}: expected finite weights, got NaN or Inf")

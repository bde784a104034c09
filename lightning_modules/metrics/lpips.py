"""LPIPS, the perceptual distance of pictures by features of AlexNet."""

from __future__ import annotations

import os
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.arguments import one_line

#: environment variable with the path of a file of all weights, of safetensors or torch
VARIABLE = "SPIKEKIT_LPIPS"

# AlexNet's convolutions: stride, padding, and whether pooling comes before
_LAYERS = (4, 2, False), (1, 2, True), (1, 1, True), (1, 1, False), (1, 1, False)
# their names in torchvision's file
_TORCHVISION, _FEATURES = "alexnet-owt-7be5be79.pth", (0, 3, 6, 8, 10)
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_SMALLEST = 31  # smallest side in pixels for which the last layer has an output


def lpips(rgb: Tensor, truth: Tensor, weights: str | Path | None = None) -> Tensor:
    r"""Return the learned perceptual image patch similarity, version 0.1 with AlexNet; lower is better.

    .. math:: d = \sum_l \operatorname{mean}_{y, x} \sum_c w_{lc} \bigl( \hat f_{lc} - \hat f^*_{lc} \bigr)^2

    with the features :math:`f_l` after each ReLU, normalised per pixel.

    Convention:
        Pictures are rescaled from [0, 1] to [-1, 1], as in the training of the metric. The programs of CSCSR's authors
        do not rescale them, so the values in the paper are on another scale.

    Args:
        rgb: pictures :math:`(B, 3, H, W)`, clamped to [0, 1].
        truth: ground truth of the same shape, clamped to [0, 1].
        weights: path of the weights. Default: the result of :func:`find_weights`.

    Returns:
        A value per picture, :math:`(B)`, float32; NaN if a side is below 31 pixels, too small for AlexNet.

    Raises:
        FileNotFoundError: there are no weights; the message says how to get them.
        ValueError: the file does not hold weights of LPIPS.

    Reference:
        Zhang et al., The Unreasonable Effectiveness of Deep Features as a Perceptual Metric, CVPR 2018.
    """
    found = _weights(tuple(map(str, [weights] if weights else find_weights())), rgb.device)
    if min(rgb.shape[-2:]) < _SMALLEST:
        return rgb.new_full(rgb.shape[:1], torch.nan, dtype=torch.float32)
    pairs = zip(rgb.split(1), truth.split(1), strict=True)  # one at a time, to limit the memory of the features
    with torch.autocast(rgb.device.type, enabled=False):
        return torch.cat([_distance(torch.cat(pair).float().clamp(0, 1), found) for pair in pairs])


def find_weights() -> list[Path]:
    """Return the local files of the weights of LPIPS; nothing is downloaded.

    These are the file in the environment variable ``SPIKEKIT_LPIPS``, with tensors conv0 .. conv4 (weight and bias) and
    lin0 .. lin4 (weight); or else AlexNet in torchvision's cache, and the heads in torchmetrics.

    Raises:
        FileNotFoundError: there are no weights.
    """
    named = os.environ.get(VARIABLE)
    if named:
        if not Path(named).expanduser().is_file():
            raise FileNotFoundError(f"{VARIABLE}: expected a file of weights, got {named}, which is not a file")
        return [Path(named).expanduser()]
    alexnet = Path(torch.hub.get_dir()) / "checkpoints" / _TORCHVISION
    metrics = find_spec("torchmetrics")
    heads = Path(metrics.origin).parent / "functional/image/lpips_models/alex.pth" if metrics else Path()
    if alexnet.is_file() and heads.is_file():
        return [alexnet, heads]
    raise FileNotFoundError(
        f"expected the weights of LPIPS, as a file named in {VARIABLE} or as torchvision's {alexnet}, got none"
    )


@lru_cache(maxsize=2)
def _weights(paths: tuple[str, ...], device: torch.device) -> dict[str, Tensor]:
    tensors: dict[str, Tensor] = {}
    for path in paths:
        try:
            if path.endswith(".safetensors"):
                from safetensors.torch import load_file

                tensors |= load_file(path)
            else:
                tensors |= torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # the type depends on the file
            raise ValueError(f"{path}: not the weights of LPIPS ({one_line(error)[:200]})") from error
    for n, feature in enumerate(_FEATURES):
        renamed = {f"conv{n}.{part}": f"features.{feature}.{part}" for part in ("weight", "bias")}
        renamed[f"lin{n}.weight"] = f"lin{n}.model.1.weight"
        tensors |= {name: tensors[other] for name, other in renamed.items() if other in tensors}
        channels = (64, 192, 384, 256, 256)[n]
        for name in (f"conv{n}.weight", f"conv{n}.bias", f"lin{n}.weight"):
            if name not in tensors or channels not in tensors[name].shape[:2]:
                got = tuple(tensors[name].shape) if name in tensors else "none"
                raise ValueError(
                    f"{paths[0]}: not the weights of LPIPS: expected {name} with {channels} channels, got {got}"
                )
    return {name: value.to(device, torch.float32) for name, value in tensors.items()}


def _distance(pair: Tensor, weights: dict[str, Tensor]) -> Tensor:
    """Return the distance (1) of two pictures (2, 3, H, W)."""
    shift, scale = (pair.new_tensor(values)[:, None, None] for values in (_SHIFT, _SCALE))
    features, distance = (2 * pair - 1 - shift) / scale, pair.new_zeros(1)
    for n, (stride, padding, pooled) in enumerate(_LAYERS):
        features = F.max_pool2d(features, 3, 2) if pooled else features
        features = F.conv2d(features, weights[f"conv{n}.weight"], weights[f"conv{n}.bias"], stride, padding).relu()
        first, second = features / (features.square().sum(dim=1, keepdim=True).sqrt() + 1e-10)
        distance = distance + F.conv2d((first - second).square()[None], weights[f"lin{n}.weight"]).mean(dim=(1, 2, 3))
    return distance

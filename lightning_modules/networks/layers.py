"""Building blocks of CSCSR."""

from __future__ import annotations

from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spikekit.kernels import compiler_kept_out
from spikekit.warp.site_search import apart


def channels_last(planes: Tensor) -> Tensor:
    """Convert (B, C, H, W) to the channels-last memory format, which makes convolutions faster."""
    return planes.contiguous(memory_format=torch.channels_last)


def enlarge(features: Tensor, scale: int) -> Tensor:
    """Enlarge bilinearly, (*, C, H, W) to (*, C, s H, s W)."""
    if scale == 1:
        return features
    planes = features.reshape(-1, *features.shape[-3:])
    planes = F.interpolate(planes, scale_factor=scale, mode="bilinear", align_corners=False)
    return planes.reshape(*features.shape[:-2], *planes.shape[-2:])


@compiler_kept_out
@lru_cache
def _cubic(scale: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the weights of the pixels around a pixel for its s^2 enlarged pixels, (s^2, 1, 5, 5)."""

    def make() -> Tensor:
        single = torch.eye(25, dtype=dtype, device=device).reshape(25, 1, 5, 5)
        large = F.interpolate(single, scale_factor=scale, mode="bicubic")
        middle = slice(2 * scale, 3 * scale)
        return large[:, 0, middle, middle].flatten(1).T.reshape(-1, 1, 5, 5).contiguous()

    return apart(make)


def enlarge_smoothly(planes: Tensor, scale: int) -> Tensor:
    """Enlarge bicubically, (B, C, H, W) to the pixels of (B, C, s H, s W) as channels, (B, C s^2, H, W)."""
    if scale == 1:
        return planes
    around = channels_last(F.pad(planes, (2, 2, 2, 2), "replicate"))
    weight = _cubic(scale, planes.dtype, planes.device)
    return F.conv2d(around, weight.repeat(planes.shape[1], 1, 1, 1), groups=planes.shape[1])


def fold(planes: Tensor, size: int) -> Tensor:
    """Apply ``pixel_unshuffle`` and :func:`channels_last` at once, (B, C, size H, size W) to (B, C size^2, H, W)."""
    batch, channels, height, width = planes.shape
    blocks = planes.reshape(batch, channels, height // size, size, width // size, size).permute(0, 2, 4, 1, 3, 5)
    return channels_last(blocks.flatten(3).movedim(-1, 1))


def conv(inputs: int, outputs: int) -> nn.Conv2d:
    """Return a 3 x 3 convolution that keeps the size."""
    return nn.Conv2d(inputs, outputs, 3, padding=1)


def fused_conv(x: Tensor, weight: Tensor, bias: Tensor, add: Tensor | None = None) -> Tensor:
    """Return the sum of a 3 x 3 convolution and ``add``, or its ReLU; in inference on a CPU in one pass, by oneDNN."""
    dtype = torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else x.dtype
    if x.is_cpu and (add is None or add.dtype == dtype) and _one_pass(dtype):
        return _by_onednn(x.to(dtype), weight.to(dtype), bias.to(dtype), add)
    seen = F.conv2d(x, weight, bias, padding=1)
    return seen.relu_() if add is None else add + seen


def _by_onednn(x: Tensor, weight: Tensor, bias: Tensor, add: Tensor | None) -> Tensor:
    how = weight, bias, (1, 1), (1, 1), (1, 1), 1
    if add is None:
        return torch.ops.mkldnn._convolution_pointwise(x, *how, "relu", [], None)
    return torch.ops.mkldnn._convolution_pointwise.binary(x, add, *how, "add", None, None, [], None)


def _one_pass(dtype: torch.dtype) -> bool:
    """Return whether oneDNN takes the dtype, and nobody differentiates, traces or counts operations."""
    if torch.is_grad_enabled() or torch.compiler.is_compiling() or torch.jit.is_tracing():
        return False
    return _has_onednn(dtype) and not torch._C._len_torch_dispatch_stack()


@lru_cache
def _has_onednn(dtype: torch.dtype) -> bool:
    """Try it once: the operation is PyTorch's own, which another version or processor may lack."""
    try:
        torch._C._len_torch_dispatch_stack()
        x = torch.ones(1, 1, 3, 3, dtype=dtype, device="cpu")
        known = (_by_onednn(x, x, x[0, 0, 0, :1], add) for add in (None, x))
        return [y[0, 0, 1, 1].item() for y in known] == [10, 11]
    except (AttributeError, NotImplementedError, RuntimeError, TypeError):
        return False


class ConvBlock(nn.Sequential):
    """3 x 3 convolution and ReLU (Fig. 4)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(conv(inputs, outputs), nn.ReLU(inplace=True))

    def forward(self, x: Tensor) -> Tensor:  # noqa: D102
        return fused_conv(x, self[0].weight, self[0].bias)


class ResBlock(nn.Module):
    """Residual block without normalisation: convolution, activation, convolution, plus the input."""

    def __init__(self, width: int, activation: nn.Module | None = None) -> None:
        super().__init__()
        self.body = nn.Sequential(conv(width, width), activation or nn.ReLU(inplace=True), conv(width, width))

    def forward(self, x: Tensor) -> Tensor:  # noqa: D102
        first, activation, last = self.body
        seen = fused_conv(x, first.weight, first.bias) if isinstance(activation, nn.ReLU) else activation(first(x))
        return fused_conv(seen, last.weight, last.bias, x)


def res_blocks(width: int, count: int) -> nn.Sequential:
    """Return a sequence of residual blocks."""
    return nn.Sequential(*(ResBlock(width) for _ in range(count)))


class NoiseLevel(nn.Module):
    """Gain and shift per channel, linear in the noise level of the sensor; the identity at level 0.

    This is a FiLM layer (Perez et al., AAAI 2018). Before training it is the identity at every level.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.zeros(width, 1, 1))
        self.shift = nn.Parameter(torch.zeros(width, 1, 1))

    def forward(self, features: Tensor, level: Tensor | None) -> Tensor:  # noqa: D102
        return features if level is None else features * (1 + level * self.gain) + level * self.shift


def start_pixel_by_pixel(part: nn.Module) -> None:
    """Initialise convolutions with orthogonal centre taps and small outer taps (Xiao et al., ICML 2018).

    A dozen random 3 x 3 filters in sequence blur the input: training then stays on a plateau for hundreds of steps, or
    never leaves it.
    """
    for module in part.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
            module.weight.data *= 0.2
            module.weight.data[:, :, 1, 1] += nn.init.orthogonal_(torch.empty(module.weight.shape[:2]), gain=1.2)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
    for module in part.modules():
        if isinstance(module, ResBlock):
            module.body[-1].weight.data *= 0.1

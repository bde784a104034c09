"""Packed spikes: one bit per pixel, for an eighth of the memory and of the transfers to a GPU."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from spikekit.check import check_planes, check_whole
from spikekit.kernels import operator, register_kernel

_NOT_BITS = "spikes: expected zeros and ones, got other values"


@operator(lambda spikes: spikes.new_empty((*spikes.shape[:-1], (spikes.shape[-1] + 7) // 8), dtype=torch.uint8))
def _pack_bits(spikes: Tensor) -> Tensor:
    bits = spikes != 0
    if not torch.equal(bits.to(spikes.dtype), spikes):
        raise ValueError(_NOT_BITS)
    eights = F.pad(bits.to(torch.uint8), (0, -spikes.shape[-1] % 8)).unflatten(-1, (-1, 8))
    return (eights << torch.arange(8, dtype=torch.uint8, device=spikes.device)).sum(-1, dtype=torch.uint8)


@register_kernel(_pack_bits, "cpu")
def _(spikes: Tensor) -> Tensor:
    values = (spikes.float() if spikes.dtype is torch.bfloat16 else spikes).numpy()  # NumPy has no bfloat16
    bits = values if values.dtype == np.uint8 else values != 0
    if not (values.max(initial=0) <= 1 if bits is values else np.array_equal(bits, values)):
        raise ValueError(_NOT_BITS)
    return torch.from_numpy(np.packbits(bits, axis=-1, bitorder="little"))


@operator(lambda packed, width: packed.new_empty((*packed.shape[:-1], width)))
def _unpack_bits(packed: Tensor, width: int) -> Tensor:
    places = torch.arange(8, dtype=torch.uint8, device=packed.device)
    return ((packed[..., None] >> places) & 1).flatten(-2)[..., :width].contiguous()


@register_kernel(_unpack_bits, "cpu")
def _(packed: Tensor, width: int) -> Tensor:
    return torch.from_numpy(np.unpackbits(packed.numpy(), axis=-1, count=width, bitorder="little"))


def pack_spikes(spikes: Tensor) -> Tensor:
    r"""Pack 8 neighbouring pixels of a row into a byte.

    .. math:: P_{y, j} = \sum_{i=0}^{7} 2^i S_{y, 8 j + i}

    Convention:
        The leftmost pixel is the least significant bit, as in a ``.dat``. Every row starts at a new byte; if 8 does not
        divide W, the last bits of a row are 0. Packing is lossless, so values other than 0 and 1 are an error; on a
        GPU, checking this requires a synchronisation. No gradient.

    Args:
        spikes: :math:`(*, H, W)`, zeros and ones, any real dtype; usually :math:`(T, H, W)`.

    Returns:
        Bytes :math:`(*, H, \lceil W / 8 \rceil)`, uint8, on the device of ``spikes``.

    Raises:
        TypeError: ``spikes`` is not a tensor of real numbers.
        ValueError: ``spikes`` has fewer than two dimensions, no pixels, or values other than 0 and 1.

    Example:
        >>> pack_spikes(torch.tensor([[1, 0, 0, 0, 0, 0, 0, 0, 1, 1]]))
        tensor([[1, 3]], dtype=torch.uint8)
    """
    check_planes("spikes", spikes, 2, "(*, H, W)")
    return _pack_bits(spikes.detach())


def unpack_spikes(packed: Tensor, width: int, *, dtype: torch.dtype = torch.uint8) -> Tensor:
    r"""Unpack bytes to one value per pixel.

    Convention:
        The inverse of :func:`pack_spikes`, bit for bit. Bits of a row beyond ``width`` are ignored.

    Args:
        packed: bytes :math:`(*, H, \lceil W / 8 \rceil)`, uint8; usually :math:`(T, H, \lceil W / 8 \rceil)`.
        width: W, pixels in a row.
        dtype: dtype of the result; any real type.

    Returns:
        Zeros and ones :math:`(*, H, W)` on the device of ``packed``.

    Raises:
        TypeError: ``packed`` is not a tensor of bytes.
        ValueError: ``packed`` has fewer than two dimensions or no bytes, or ``width`` needs another number of bytes.

    Example:
        >>> packed = torch.tensor([[1, 3]], dtype=torch.uint8)
        >>> unpack_spikes(packed, 10)
        tensor([[1, 0, 0, 0, 0, 0, 0, 0, 1, 1]], dtype=torch.uint8)
    """
    check_planes("packed", packed, 2, "(*, H, ceil(W / 8))")
    if packed.dtype is not torch.uint8:
        raise TypeError(f"packed: expected bytes, torch.uint8, got {packed.dtype}")
    width = check_whole("width", width)
    if packed.shape[-1] != (width + 7) // 8:
        row = packed.shape[-1]
        raise ValueError(f"width: expected {8 * row - 7} .. {8 * row} for rows of {row} bytes, got {width}")
    spikes = _unpack_bits(packed, width)
    return spikes.view(dtype) if dtype is torch.bool else spikes.to(dtype=dtype)

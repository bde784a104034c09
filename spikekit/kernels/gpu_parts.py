"""Helpers of the GPU kernels."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import torch
import triton
import triton.language as tl


def launch(kernel: Any, programs: int, *args: Any, **constants: Any) -> None:
    """Launch ``programs`` programs of a kernel on the device of its first argument."""
    device = args[0].device
    if programs:
        with torch.cuda.device(device) if device.type == "cuda" else nullcontext():
            kernel[(programs,)](*args, **constants, enable_fp_fusion=False)


@triton.jit
def my_pixels(pixels, block: tl.constexpr):
    """Return stream and pixels of this program, as 64-bit element offsets, and the mask of existing pixels."""
    blocks = tl.cdiv(pixels, block)
    program = tl.program_id(0)
    pixel = (program % blocks).to(tl.int64) * block + tl.arange(0, block)
    return (program // blocks).to(tl.int64), pixel, pixel < pixels


@triton.jit
def store(pointer, value, mask):
    """Store floats; uint8 is rounded half to even and clamped, half precision is converted from float32."""
    if pointer.dtype.element_ty == tl.uint8:
        value = tl.minimum(tl.maximum(value, 0.0), 255.0)
        whole = value.to(tl.int32)
        rest = value - whole.to(value.dtype)
        up = (rest > 0.5) | ((rest == 0.5) & (whole % 2 == 1))
        tl.store(pointer, (whole + up.to(tl.int32)).to(tl.uint8), mask=mask)
    elif pointer.dtype.element_ty == tl.float64:
        tl.store(pointer, value.to(tl.float64), mask=mask)
    else:
        tl.store(pointer, value.to(tl.float32).to(pointer.dtype.element_ty), mask=mask)

"""Predict a picture from a clip, with tiles and self-ensemble."""

from __future__ import annotations

import os

import torch
from torch import Tensor

from lightning_modules.inference.self_ensemble import COUNTS
from lightning_modules.inference.self_ensemble import self_ensemble as mean_of_views
from lightning_modules.inference.tiles import TILE, forward_in_tiles
from lightning_modules.networks import Network


def predict(
    network: Network,
    spikes: Tensor,
    flow: Tensor | None = None,
    static: bool = False,
    *,
    tile: int = TILE,
    self_ensemble: int = 1,
    exposure: float | Tensor = 1.0,
) -> Tensor:
    r"""Return the picture at the middle of a clip.

    Args:
        network: network of :mod:`lightning_modules.networks`.
        spikes: :math:`(B, N, H, W)`.
        flow: from the middle to the first and the last time point, :math:`(B, 2, 2, H, W)`, in sensor pixels; default:
            the estimate of the network.
        static: nothing moves; replaces a flow.
        tile: side of a tile in sensor pixels, 0 for no tiles, see
            :func:`lightning_modules.inference.tiles.forward_in_tiles`.
        self_ensemble: number of views to average, 1, 2, 4 or 8, see
            :func:`lightning_modules.inference.self_ensemble.self_ensemble`.
        exposure: factor of the picture before it is clamped, a number or (B, 1, 1, 1).

    Returns:
        rgb :math:`(B, 3, s H, s W)`, clamped to [0, 1].

    Raises:
        ValueError: ``self_ensemble`` is not 1, 2, 4 or 8.

    Example:
        >>> import torch
        >>> from lightning_modules.networks import ClassicalDecoder
        >>> predict(ClassicalDecoder(scale=2), torch.ones(1, 41, 16, 16), self_ensemble=2).shape
        torch.Size([1, 3, 32, 32])
    """
    check_views(self_ensemble)

    def run(spikes: Tensor, flow: Tensor | None) -> Tensor:
        return forward_in_tiles(network, spikes, tile, flow, static)

    rgb = mean_of_views(run, spikes, flow, network.pattern, network.scale, self_ensemble)
    return (rgb * exposure).clamp_(0, 1)


def check_views(self_ensemble: int) -> None:
    """Check a number of views: 1, 2, 4 or 8."""
    if isinstance(self_ensemble, bool) or self_ensemble not in COUNTS:
        raise ValueError(f"self_ensemble: expected one of {COUNTS}, got {self_ensemble!r}")


def precision_of(device: torch.device) -> str:
    """Return bfloat16 for a GPU or a processor that computes in it, float32 otherwise."""
    able = device.type == "cuda" and torch.cuda.is_bf16_supported()
    return "bf16-mixed" if able or (device.type == "cpu" and _cpu_computes_in_bfloat16()) else "32-true"


def _cpu_computes_in_bfloat16() -> bool:
    """Whether torch may use bfloat16 instructions of the processor; emulated, bfloat16 is slower than float32."""
    asked = getattr(torch.cpu, "get_capabilities", dict)()  # from torch 2.10 on
    allowed = os.environ.get("ONEDNN_MAX_CPU_ISA", "DEFAULT").upper()
    allowed = allowed in ("DEFAULT", "ALL") or "BF16" in allowed or "AMX" in allowed
    return bool(asked.get("avx512_bf16")) and torch.backends.cpu.get_cpu_capability() == "AVX512" and allowed

"""Classical baseline without weights: decode, demosaic, enlarge."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from lightning_modules.motion import ZeroFlow
from lightning_modules.networks.network import Network
from spikekit import demosaic, tfi_at, tfp_at
from spikekit.check import check_planes, check_positive, check_whole
from spikekit.color.cfa import cfa_pattern

#: The decoders by name.
METHODS = ("tfi", "tfp")


class ClassicalDecoder(Network):
    r"""Classical decoder: TFI or TFP of the middle frame, demosaicing and bicubic enlargement.

    In clips longer than ``frames``, as in dim light, the window of TFP grows with the cube root of the length, and TFI
    replaces TFP where fewer than two spikes are averaged; TFP of order k averages about sqrt(k) windows.

    Args:
        method: decoder, ``"tfi"`` or ``"tfp"``.
        scale: super-resolution factor s.
        pattern: Bayer phase, or ``"grey"``.
        alpha: gain of the camera: light of a white pixel per clock, in thresholds. The picture is light divided by it.
        window: number of spike frames that TFP averages, odd.
        order: number of averaging passes of TFP, see :func:`spikekit.tfp`.
        frames: number N of spike frames per clip, odd.

    Shape:
        - Input: spikes :math:`(B, N, H, W)`, any real dtype
        - Output: rgb :math:`(B, 3, s H, s W)`, or :math:`(B, 1, s H, s W)` for a grey sensor

    Example:
        >>> import torch
        >>> ClassicalDecoder("tfp", scale=2)(torch.ones(1, 41, 8, 8)).shape
        torch.Size([1, 3, 16, 16])
    """

    halo = 4  # two pixels for demosaicing and two for bicubic enlargement
    takes_flow = False
    joins = False

    def __init__(
        self,
        method: str = "tfp",
        scale: int = 4,
        pattern: str = "RGGB",
        alpha: float = 0.4,
        window: int = 41,
        order: int = 1,
        frames: int = 41,
    ) -> None:
        scale = check_whole("scale", scale)
        check_positive("alpha", alpha)
        if method not in METHODS:
            raise ValueError(f"method: expected {' or '.join(map(repr, METHODS))}, got {method!r}")
        if min(frames, window) < 1 or frames % 2 == 0 or window % 2 == 0:
            raise ValueError(f"frames, window: expected odd numbers, got {frames} and {window}")
        settings = {
            "method": method,
            "scale": scale,
            "pattern": cfa_pattern(pattern),
            "alpha": alpha,
            "window": window,
            "order": check_whole("order", order),
            "frames": frames,
        }
        super().__init__(settings, (frames // 2,) * 3, ZeroFlow())
        self.method, self.window, self.order = method, window, order

    def forward(self, spikes: Tensor, flow: Tensor | None = None, static: bool = False) -> Tensor:
        """Return rgb; the flow is ignored."""
        check_planes("spikes", spikes, 4, "(B, N, H, W)")
        n = spikes.shape[1] // 2
        window = round(self.window * (longer := max(spikes.shape[1] / self.frames, 1)) ** (1 / 3)) // 2 * 2 + 1
        raw = tfi_at(spikes, n) if self.method == "tfi" else tfp_at(spikes, n, window, order=self.order)
        if self.method == "tfp" and longer > 1:
            raw = torch.where((sparse := tfi_at(spikes, n)) < 2 / (window * self.order**0.5), sparse, raw)
        rgb = demosaic(raw / self.alpha, self.pattern)
        if self.scale > 1:
            rgb = F.interpolate(rgb, scale_factor=self.scale, mode="bicubic", align_corners=False)
        return rgb

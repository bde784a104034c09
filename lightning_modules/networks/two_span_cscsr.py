"""Two CSCSR networks, one for shorter and one for longer clips: the local motion decides between them."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from kornia.core.utils import is_exporting
from kornia.filters import gaussian_blur2d
from torch import Tensor, nn

from lightning_modules.networks.cscsr import CSCSR
from lightning_modules.networks.network import Network

# sensor pixels a clock: slower, the longer clip alone is seen, faster, the shorter one alone
_SLOW, _FAST = 1.5 / 45, 4 / 45
_AROUND = 2  # sensor pixels around a place whose motion counts as its own
_BLEND = 4.0  # standard deviation of the transition, in sensor pixels


class ShareOfLong(nn.Module):
    """How much of a picture is that of the longer clip.

    Args:
        flow_times: spike frames that the flows of the longer clip run between: first, middle, last.

    Shape:
        - Input: flows of the longer clip, :math:`(B, 2, 2, H, W)`
        - Output: :math:`(B, 1, H, W)`, in [0, 1]
    """

    def __init__(self, flow_times: tuple[int, int, int]) -> None:
        super().__init__()
        self.flow_times = flow_times

    def forward(self, flow: Tensor) -> Tensor:  # noqa: D102
        first, middle, last = self.flow_times
        clocks = flow.new_tensor([middle - first, last - middle]).reshape(2, 1, 1)
        speed = (flow.norm(dim=2) / clocks).amax(dim=1, keepdim=True)
        speed = F.max_pool2d(speed, 2 * _AROUND + 1, 1, _AROUND)
        radius = min(int(2 * _BLEND), *(side - 1 for side in speed.shape[-2:]))
        speed = gaussian_blur2d(speed, 2 * radius + 1, (_BLEND, _BLEND))
        return ((_FAST - speed) / (_FAST - _SLOW)).clamp(0, 1)


class TwoSpanCSCSR(Network):
    r"""Super-resolution from as many clocks as the scene allows: many where motion is slow, few where it is fast.

    Both networks are trained already. What moves slowly is seen by the one of the longer clip, what moves fast by the
    other, each on the middle of the same clip; between the two speeds their pictures are blended, and that is better
    than either. A part that only one of them sees costs only that one.

    Args:
        scale: super-resolution factor, that of the weights.
        frames: spike frames N of a clip, those of the longer one.
        pattern: Bayer phase, that of the weights.
        alpha: gain of the camera, what a white pixel receives per clock in thresholds.
        short: weights of CSCSR for the shorter clip: a name of the package, or a file.
        long: those for the longer one.

    Shape:
        - Input: spikes :math:`(B, N, H, W)`; optionally the flows of :class:`CSCSR`, for the longer clip,
          :math:`(B, 2, 2, H, W)`, or those for the shorter and for the longer one, :math:`(B, 2, 2, 2, H, W)`
        - Output: rgb :math:`(B, 3, s H, s W)`, not clamped

    Raises:
        FileNotFoundError: there are no such weights.
        ValueError: weights of another scale, pattern or number of frames, or with the longer clips as ``short``.

    Example:
        >>> network = TwoSpanCSCSR()
        >>> network(torch.zeros(1, 101, 12, 10), static=True).shape
        torch.Size([1, 3, 48, 40])
    """

    flow_groups = ((), (2,))

    def __init__(
        self,
        scale: int = 4,
        frames: int = 101,
        pattern: str = "RGGB",
        alpha: float = 0.4,
        short: str = "cscsr_huge_x4",
        long: str = "cscsr_huge_long_x4",
    ) -> None:
        parts = {name: CSCSR.from_pretrained(name, alpha=alpha) for name in (short, long)}
        few, many = parts[short], parts[long]
        for name, part in parts.items():
            for key, asked in (("scale", scale), ("pattern", pattern)):
                if part.settings[key] != asked:
                    raise ValueError(f"{key}: expected {part.settings[key]}, that of {name}, got {asked}")
        if not few.frames < many.frames == frames:
            expected = f"{many.frames}, those of {long}, more than the {few.frames} of {short}"
            raise ValueError(f"frames: expected {expected}, got {frames}")
        settings = {"scale": scale, "frames": frames, "pattern": pattern, "alpha": alpha, "short": short, "long": long}
        super().__init__(settings, many.flow_times, many.motion)
        self.short, self.long = (part.requires_grad_(False) for part in (few, many))
        ends = (torch.tensor(part.flow_times[::2]) - part.flow_times[1] for part in (few, many))
        self._nearer = torch.div(*ends).reshape(2, 1, 1, 1)  # what a flow of the longer clip is at the shorter's ends
        self.share_of_long = ShareOfLong(many.flow_times)
        self.halo = max(few.halo, many.halo)
        self.error_model = many.error_model

    def estimate_flow(self, spikes: Tensor) -> Tensor:
        """Flows of the shorter and of the longer clip, (B, 2, 2, 2, H, W), see :meth:`CSCSR.estimate_flow`."""
        return torch.stack([self.short.estimate_flow(self._middle(spikes)), self.long.estimate_flow(spikes)], dim=1)

    def forward(self, spikes: Tensor, flow: Tensor | None = None, static: bool = False) -> Tensor:  # noqa: D102
        self.check_spikes(spikes)
        flow = self.resolve_flow(spikes, flow, static)
        if flow is None:
            return self.long(spikes, static=True)
        if flow.ndim == 5:
            flow = torch.stack([flow * self._nearer.to(flow), flow], dim=1)
        few, many = flow.unbind(dim=1)
        share = self.share_of_long(many)
        if not is_exporting():  # a program does the same for every clip
            if share.min() == 1:
                return self.long(spikes, many)
            if share.max() == 0:
                return self.short(self._middle(spikes), few)
        rgb = self.short(self._middle(spikes), few)
        share = F.interpolate(share.to(rgb), scale_factor=self.scale, mode="bilinear", align_corners=False)
        return torch.lerp(rgb, self.long(spikes, many), share)

    def _middle(self, spikes: Tensor) -> Tensor:
        first = self.frames // 2 - self.short.frames // 2
        return spikes[:, first : first + self.short.frames]

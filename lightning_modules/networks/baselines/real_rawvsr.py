"""Real-RawVSR, joint demosaicing and super-resolution of raw video, on mosaics of TFI or TFP."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lightning_modules.motion import ZeroFlow
from lightning_modules.networks.baselines.parts import (
    Baseline,
    Decoder,
    DeformableConv2d,
    begin_at_zero,
    check_decoder,
    cut_to,
    decode_pictures,
    enlarged_raw,
    mirror_to_multiple,
    whole_sizes,
)
from lightning_modules.networks.layers import ResBlock, conv, enlarge
from lightning_modules.signatures import inherit_signature
from spikekit import split_bayer

_LEVELS = 3
_FRAMES = 5


class RealRawVSR(Baseline):
    r"""Real-RawVSR (Yue et al., ECCV 2022) on decoded mosaics, the paper's TFI+Real-RawVSR and TFP+Real-RawVSR.

    As published: two branches, one for the mosaics and one for the mosaics packed as four channels of half the size;
    features on three levels; deformable alignment of neighbours to the middle, with offsets of both branches from the
    packed one; exchange of features between the branches; attention over time; fusion in time and space as in EDVR; a
    selective kernel over the branches; ten residual blocks; convolutional skips from the middle mosaic of each branch.

    Differences: TFI or TFP decodes the five mosaics, at frames 10, 15, 20, 25 and 30 of 41. Attention over time is
    scaled by the square root of the number of values, as usual. There is no colour correction with the ground truth.
    Sides are padded by reflection to multiples of 8, as the levels require. A ``width`` of 24 takes as much work as
    CSCSR's size small.

    Attention and the selective kernel depend on the whole picture, so the network does not run in tiles.

    Args:
        scale, frames, pattern, alpha: see :class:`Baseline`.
        decoder: ``"tfi"``, or ``"tfp"``, which averages 41 frames.
        width: channels, a multiple of 8.
        blocks: residual blocks after fusion; each branch has half as many before it.
        skip: predict a residual, which is added to the middle mosaic, demosaiced by residual interpolation and enlarged
            bicubically, so that training starts from the result of the decoder. The publication has no such skip.

    Shape:
        - Input: spikes :math:`(B, N, H, W)`, zeros and ones of any real dtype; the flow is ignored
        - Output: rgb :math:`(B, 3, s H, s W)`, not clamped

    Example:
        >>> RealRawVSR(scale=2, width=8, blocks=2)(torch.zeros(1, 41, 8, 6)).shape
        torch.Size([1, 3, 16, 12])
    """

    takes_flow = False

    @inherit_signature(Baseline, "more", "motion")
    def __init__(
        self,
        *args: Any,
        decoder: Decoder = "tfi",
        width: int = 64,
        blocks: int = 10,
        skip: bool = False,
        **common: Any,
    ) -> None:
        check_decoder(decoder)
        more = {"decoder": decoder, **whole_sizes(width=width, blocks=blocks), "skip": skip}
        super().__init__(*args, **common, motion=ZeroFlow(), more=more)
        self.decoder, self.skip = decoder, skip
        middle, apart = self.frames // 2, self.frames // 8
        self.times = tuple(middle + n * apart for n in range(-(_FRAMES // 2), _FRAMES // 2 + 1))
        self.raw_features, self.packed_features = (_Pyramid(inputs, width, blocks // 2) for inputs in (1, 4))
        self.align = _Alignment(width)
        self.to_raw = nn.Sequential(conv(width, 4 * width), nn.PixelShuffle(2), _relu())
        self.to_packed = nn.Sequential(nn.Conv2d(width, width, 3, 2, 1), _relu())
        self.raw_attention, self.packed_attention = _TemporalAttention(), _TemporalAttention()
        self.fuse_raw, self.fuse_packed = _Fusion(2 * _FRAMES, width), _Fusion(2 * _FRAMES, width)
        self.enlarge_packed = nn.Sequential(conv(width, 4 * width), nn.PixelShuffle(2), _relu(), conv(width, width))
        self.select = _SelectiveKernel(width)
        self.body = nn.Sequential(*(ResBlock(width, _relu()) for _ in range(blocks)))
        self.enlarge = _Enlargement(width, self.scale)
        if skip:
            begin_at_zero(*self.enlarge.pictures)

    def forward(self, spikes: Tensor, flow: Tensor | None = None, static: bool = False) -> Tensor:
        """Return rgb; the flow is ignored."""
        self.check_spikes(spikes)
        height, width = spikes.shape[-2:]
        spikes = mirror_to_multiple(spikes, 8).to(self.align.cascade.weight.dtype)
        raws = decode_pictures(spikes, self.times, self.alpha, self.decoder)  # (B, T, H, W)
        packed = split_bayer(raws, self.pattern).movedim(0, 2)  # (B, T, 4, H / 2, W / 2)
        fused = self._fuse(*self._align(raws.unsqueeze(2), packed))
        middle = _FRAMES // 2
        rgb = self.enlarge(self.body(fused), raws[:, middle : middle + 1], packed[:, middle])
        rgb = cut_to(rgb, self.scale * height, self.scale * width)
        if self.skip:
            rgb = rgb + enlarged_raw(cut_to(raws[:, middle], height, width), self.pattern, self.scale)
        return rgb.to(spikes.dtype)

    def _align(self, raws: Tensor, packed: Tensor) -> tuple[Tensor, Tensor]:
        """Return features of both branches, aligned to the middle, (B, T, C, H, W) and (B, T, C, H / 2, W / 2)."""
        times = raws.shape[:2]
        raw, packed = self.raw_features(raws.flatten(0, 1)), self.packed_features(packed.flatten(0, 1))
        middle = [level.unflatten(0, times)[:, _FRAMES // 2].repeat_interleave(_FRAMES, dim=0) for level in packed]
        return tuple(branch.unflatten(0, times) for branch in self.align(raw, packed, middle))

    def _fuse(self, raw: Tensor, packed: Tensor) -> Tensor:
        """Fuse the times and the branches, to (B, C, H, W)."""
        times = raw.shape[:2]
        told_raw = self.to_raw(packed.flatten(0, 1)).unflatten(0, times)
        told_packed = self.to_packed(raw.flatten(0, 1)).unflatten(0, times)
        raw = self.fuse_raw(self.raw_attention(torch.cat([raw, told_raw], dim=1)), _FRAMES // 2)
        packed = self.fuse_packed(self.packed_attention(torch.cat([packed, told_packed], dim=1)), _FRAMES // 2)
        return self.select(raw, self.enlarge_packed(packed))


def _relu() -> nn.LeakyReLU:
    return nn.LeakyReLU(0.1)


class _Pyramid(nn.Module):
    """Features on three levels, each half the size of the previous one."""

    def __init__(self, inputs: int, width: int, blocks: int) -> None:
        super().__init__()
        self.first = nn.Sequential(conv(inputs, width), _relu(), *(ResBlock(width, _relu()) for _ in range(blocks)))
        self.shrink = nn.ModuleList(
            nn.Sequential(nn.Conv2d(width, width, 3, 2, 1), _relu(), conv(width, width), _relu())
            for _ in range(_LEVELS - 1)
        )

    def forward(self, planes: Tensor) -> list[Tensor]:
        levels = [self.first(planes)]
        for shrink in self.shrink:
            levels.append(shrink(levels[-1]))
        return levels


class _Alignment(nn.Module):
    """Pyramid, cascading and deformable alignment (EDVR) of two branches, with offsets from the packed one."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.compare = nn.ModuleList(conv(2 * width, width) for _ in range(_LEVELS))
        self.join_offsets = nn.ModuleList(conv(2 * width, width) for _ in range(_LEVELS - 1))
        self.offsets = nn.ModuleList(conv(width, width) for _ in range(_LEVELS))
        self.move = nn.ModuleList(DeformableConv2d(width) for _ in range(_LEVELS))
        self.join_features = nn.ModuleList(conv(2 * width, width) for _ in range(_LEVELS - 1))
        self.compare_again, self.offsets_again = conv(2 * width, width), conv(width, width)
        self.cascade = DeformableConv2d(width)
        self.act = _relu()

    def forward(self, raw: list[Tensor], packed: list[Tensor], middle: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Align the features of both branches to the packed features of the middle frame."""
        guide, moved = None, []
        for level in reversed(range(_LEVELS)):
            found = self.act(self.compare[level](torch.cat([packed[level], middle[level]], dim=1)))
            if guide is not None:
                found = self.act(self.join_offsets[level](torch.cat([found, 2 * enlarge(guide, 2)], dim=1)))
            guide = self.act(self.offsets[level](found))
            branches = []
            for n, (branch, where) in enumerate(((raw, 2 * enlarge(guide, 2)), (packed, guide))):
                features = self.move[level](branch[level], where)
                if moved:
                    features = self.join_features[level](torch.cat([features, enlarge(moved[n], 2)], dim=1))
                branches.append(self.act(features) if level else features)
            moved = branches
        found = self.act(self.compare_again(torch.cat([moved[1], middle[0]], dim=1)))
        guide = self.act(self.offsets_again(found))
        return self.act(self.cascade(moved[0], 2 * enlarge(guide, 2))), self.act(self.cascade(moved[1], guide))


class _TemporalAttention(nn.Module):
    """Attention between the feature maps of all times, with a learned weight that starts at 0."""

    def __init__(self) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.zeros(1))

    def forward(self, maps: Tensor) -> Tensor:
        rows = maps.flatten(2).unsqueeze(1)  # one head
        return maps + self.gamma * F.scaled_dot_product_attention(rows, rows, rows).squeeze(1).reshape(maps.shape)


class _Fusion(nn.Module):
    """Fusion with temporal and spatial attention (EDVR): (B, T, C, H, W) to (B, C, H, W), H and W divisible by 4."""

    def __init__(self, times: int, width: int) -> None:
        super().__init__()
        self.middle, self.each = conv(width, width), conv(width, width)
        self.merge = nn.Conv2d(times * width, width, 1)
        self.look = nn.Conv2d(times * width, width, 1)
        self.shrink = nn.Conv2d(2 * width, width, 1)
        self.narrow = nn.Conv2d(width, width, 1)
        self.shrink_again = conv(2 * width, width)
        self.wide = conv(width, width)
        self.near = conv(width, width)
        self.join = nn.Conv2d(width, width, 1)
        self.scale = conv(width, width)
        self.shift = nn.Sequential(nn.Conv2d(width, width, 1), _relu(), nn.Conv2d(width, width, 1))
        self.act = _relu()

    def forward(self, maps: Tensor, middle: int) -> Tensor:
        each = self.each(maps.flatten(0, 1)).unflatten(0, maps.shape[:2])
        likeness = (each * self.middle(maps[:, middle]).unsqueeze(1)).sum(dim=2, keepdim=True).sigmoid()
        maps = (maps * likeness).flatten(1, 2)
        near = self.act(self.shrink(_pooled(self.act(self.look(maps)))))
        far = self.act(self.wide(self.act(self.shrink_again(_pooled(self.act(self.narrow(near)))))))
        seen = self.act(self.join(self.act(self.near(near)) + enlarge(far, 2)))
        seen = self.scale(enlarge(seen, 2))
        return self.act(self.merge(maps)) * 2 * seen.sigmoid() + self.shift(seen)


def _pooled(maps: Tensor) -> Tensor:
    """Concatenate max pooling and average pooling to half the size."""
    return torch.cat([F.max_pool2d(maps, 3, 2, 1), F.avg_pool2d(maps, 3, 2, 1)], dim=1)


class _SelectiveKernel(nn.Module):
    """Channel weights of two branches from their mean over the picture (Li et al., CVPR 2019)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.squeeze = nn.Linear(width, 32)
        self.weigh = nn.ModuleList(nn.Linear(32, width) for _ in range(2))

    def forward(self, *branches: Tensor) -> Tensor:
        seen = self.squeeze(sum(branches).mean(dim=(-2, -1)))
        weights = torch.stack([weigh(seen) for weigh in self.weigh]).softmax(dim=0)[..., None, None]
        return sum(weight * branch for weight, branch in zip(weights, branches, strict=True))


class _Enlargement(nn.Module):
    """Enlargement of features to the picture, x4 in two steps, with a skip from the middle mosaic of each branch."""

    def __init__(self, width: int, scale: int) -> None:
        super().__init__()
        steps = [2, 2] if scale == 4 else [scale]
        self.up = nn.ModuleList(_sub_pixel(width, width, step) for step in steps)
        self.last = nn.Sequential(conv(width, width), _relu(), conv(width, 3))
        wide = steps[0] if len(steps) > 1 else 1
        self.raw = _sub_pixel(1, width, wide)
        self.packed = nn.Sequential(_sub_pixel(4, width, 2), *(_sub_pixel(width, width, step) for step in steps[:-1]))
        self.raw_picture, self.packed_picture = (_sub_pixel(width, 3, steps[-1]) for _ in range(2))
        self.act = _relu()

    @property
    def pictures(self) -> list[nn.Conv2d]:
        """Convolutions whose outputs are summed to the picture."""
        return [self.last[-1], self.raw_picture[0], self.packed_picture[0]]

    def forward(self, features: Tensor, raw: Tensor, packed: Tensor) -> Tensor:
        raw, packed = self.raw(raw), self.packed(packed)
        for n, up in enumerate(self.up):
            features = self.act(up(features))
            if n + 1 < len(self.up):
                features = features + raw + packed
        return self.last(features) + self.raw_picture(self.act(raw)) + self.packed_picture(self.act(packed))


def _sub_pixel(inputs: int, outputs: int, scale: int) -> nn.Sequential:
    return nn.Sequential(conv(inputs, scale**2 * outputs), nn.PixelShuffle(scale))

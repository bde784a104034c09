"""Render batches of scenes of still pictures on any device, from random numbers drawn before."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lightning_modules.data.pictures import read_shades, to_shades
from lightning_modules.data.textures import texture
from spikekit import SensorNoise, bin_to_sensor, spike_integrate_fire
from spikekit.color.cfa import GREY
from spikekit.scenes.analytic import Layer, Motion, Scene

_TEXTURES = 64  # drawn once and cropped differently every time
_TEXTURE = 320  # side in pixels
_TAPS = 4  # support of the cubic kernel


class Pictures:
    """Pictures, uint8 (3, h, w), by index: files, then optional procedural textures."""

    def __init__(self, paths: Sequence[Path], textures: bool) -> None:
        self.paths, self.textures = list(paths), _TEXTURES if textures else 0
        self._sizes: list[tuple[int, int]] | None = None

    def __len__(self) -> int:
        return len(self.paths) + self.textures

    def __getitem__(self, n: int) -> Tensor:
        return read_shades(self.paths[n]) if n < len(self.paths) else _texture(n - len(self.paths))

    def size(self, n: int) -> tuple[int, int]:
        """Return rows and columns of a picture."""
        return self._sizes[n] if self._sizes else tuple(self[n].shape[1:])

    def gallery(self, device: torch.device | str) -> Gallery:
        """Load all pictures to a device; their sizes are then known without reading them."""
        pictures = [self[n] for n in range(len(self))]
        self._sizes = [tuple(picture.shape[1:]) for picture in pictures]
        return Gallery.of(pictures, device)


@lru_cache(maxsize=_TEXTURES)
def _texture(n: int) -> Tensor:
    return to_shades(texture(_TEXTURE, _TEXTURE, np.random.default_rng([_TEXTURE, n])))


@dataclass(frozen=True)
class Gallery:
    """Values of P pictures of any sizes, uint8; for each the index of its first, its size, and whether it is grey."""

    shades: Tensor
    start: Tensor
    size: Tensor
    grey: Tensor

    @classmethod
    def of(cls, pictures: Sequence[Tensor], device: torch.device | str = "cpu") -> Gallery:
        """Load pictures (3, h, w) to a device."""
        counts = np.cumsum([0] + [picture.numel() for picture in pictures])
        flat = [picture.flatten() for picture in pictures]
        return cls(
            (flat[0] if len(flat) == 1 else torch.cat(flat)).to(device),
            torch.from_numpy(counts[:-1]).to(device),
            torch.tensor([picture.shape[1:] for picture in pictures], device=device),
            torch.tensor([_is_grey(picture) for picture in pictures], device=device),
        )


def _is_grey(picture: Tensor) -> bool:
    # a few pixels suffice for nearly every coloured picture
    return all(bool((part[1:] == part[:1]).all()) for part in (picture[:, ::16, ::16], picture))


def draw_cut(
    side: int, size: tuple[int, int], rng: np.random.Generator, mirror: float, least: float = 0.5
) -> np.ndarray:
    """Draw a random square crop of a picture, with ``side`` pixels after random shrinking.

    Beyond its edges the picture is mirrored; the crop is at most ``mirror`` times as long as the picture if that needs
    no enlarging. The shrinking factor is at least ``least``. The result, (2, 4), has for rows and columns: first line
    of the picture, number of lines, number of lines after resampling, and first line of the crop among these.
    """
    # Shrinking reduces grain and sharpens edges. Enlarging blurs, so only pictures below half the side are enlarged.
    shortest = min(size)
    smallest = max(least, min(1.0, side / (mirror * shortest)), side / (2 * shortest))
    factor = math.exp(rng.uniform(math.log(smallest), math.log(max(smallest, 1.0))))
    axes = []
    for lines in size:
        taken = min(math.ceil(side / factor), lines)
        resampled = max(1, round(taken * factor))
        first, begin = rng.integers(lines - taken + 1), rng.integers(max(resampled - side, 0) + 1)
        axes.append((first, taken, resampled, begin))
    return np.array(axes, "int32")


def cut_pictures(
    gallery: Gallery, which: Tensor, cuts: Tensor, sides: Tensor, side: int, taken: tuple[int, int], turn: Tensor
) -> Tensor:
    """Crop squares from pictures, (B, 3, side, side) in [0, 1]: bicubic and antialiased, by two matrix products each.

    ``cuts`` (B, 2, 4) are those of :func:`draw_cut`, ``taken`` the most rows and columns of a crop. Crops are reversed
    in rows and columns about the middles of the drawn ``sides`` (B,), and transposed, as ``turn`` (B, 3) says.
    """
    # lines beyond a crop have no weight, but must lie inside the gallery
    rows, columns = (
        torch.minimum(cut[:, :1] + torch.arange(most, device=cuts.device), cut[:, :1] + cut[:, 1:2] - 1)
        for cut, most in zip(cuts.unbind(dim=1), taken, strict=True)
    )
    height, width = gallery.size[which].unbind(dim=1)
    start = gallery.start[which][:, None] + torch.arange(3, device=cuts.device) * (height * width)[:, None]
    lines = start[:, :, None] + (rows * width[:, None])[:, None]  # (B, 3, rows)
    seen = gallery.shades[lines[..., None] + columns[:, None, None]].float()
    down, across = (_resampling(cuts[:, axis], turn[:, axis], sides, side, taken[axis]) for axis in (0, 1))
    picture = down[:, None] @ (seen @ across.mT[:, None])
    picture = (picture / 255).clamp(0, 1)
    return torch.where(turn[:, 2, None, None, None], picture.mT, picture)


def _resampling(cut: Tensor, around: Tensor, sides: Tensor, side: int, taken: int) -> Tensor:
    """Return weights (B, side, taken) that resample the lines of a crop to those of a square."""
    _, count, resampled, begin = (part[:, None] for part in cut.long().unbind(dim=1))
    line = torch.arange(side, device=cut.device)
    line = torch.where(around[:, None], sides[:, None] - 1 - line, line) + begin
    line = line.remainder(2 * resampled)
    line = torch.minimum(line, 2 * resampled - 1 - line)
    ratio = count / resampled
    at, wide = (line + 0.5) * ratio - 0.5, ratio.clamp(min=1)
    taps = _TAPS * 2 + 1  # pictures are shrunk to a half at most; more taps would have no weight
    tap = (at - 2 * wide).floor()[..., None] + 1 + torch.arange(taps, device=cut.device)
    weight = _cubic((tap - at[..., None]) / wide[..., None]) * ((tap >= 0) & (tap < count[..., None]))
    weight = weight / weight.sum(dim=-1, keepdim=True)
    full = weight.new_zeros(len(cut), side, taken)
    return full.scatter_add_(2, tap.long().clamp(0, taken - 1), weight)


def _cubic(x: Tensor) -> Tensor:
    """Evaluate Keys' cubic kernel with a = -1/2."""
    x = x.abs()
    near, far = (1.5 * x - 2.5) * x * x + 1, ((-0.5 * x + 2.5) * x - 4) * x + 2
    return torch.where(x < 1, near, torch.where(x < 2, far, 0.0))


def outline_masks(radius: Tensor, sides: Tensor, side: int) -> Tensor:
    """Return masks (B, side, side) of outlines, 1 inside, 0 outside, with an edge one pixel wide.

    Outlines are given by their radii (B, A) at A angles from -pi on, at most 1, and fill squares of ``sides`` (B,).
    """
    middle = ((sides - 1) / 2)[:, None]
    place = torch.arange(side, device=radius.device) - middle
    y, x = place[:, :, None], place[:, None, :]
    angles = radius.shape[1]
    at = (torch.atan2(y, x) / (2 * math.pi) + 0.5) * angles
    low = at.floor()
    ends = [radius.gather(1, (low.long() + n).remainder(angles).flatten(1)).reshape(at.shape) for n in (0, 1)]
    edge = (middle - 0.5).clamp(min=0.5)[..., None]
    reach = torch.lerp(*ends, at - low)
    return torch.where(reach > 0, (0.5 + reach * edge - torch.hypot(x, y)).clamp(0, 1), 0.0)


def render_scene(
    drawn: dict[str, np.ndarray], gallery: Gallery, pattern: str, side: int, margin: int, clocks: int
) -> Scene:
    """Build a batch of scenes from the numbers of :meth:`StillClips.draw`; the margin comes into view by motion."""
    device = gallery.shades.device

    def there(name: str, n: int) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(drawn[name][:, n])).to(device, non_blocking=True)

    layers = []
    for n in range(drawn["side"].shape[1]):
        sides = drawn["side"][:, n]
        if not sides.any():  # no scene has this many objects
            continue
        longest = side + 2 * margin if n == 0 else int(sides.max()) + 1
        taken = tuple(drawn["cut"][:, n, :, 1].max(axis=0).tolist())
        which = there("picture", n)
        picture = cut_pictures(gallery, which, there("cut", n), there("side", n), longest, taken, there("turn", n))
        picture = picture.gather(1, there("colours", n)[:, :, None, None].expand(picture.shape))
        dark, bright = there("tint", n).unbind(dim=1)
        tinted = dark[..., None, None] + (bright - dark)[..., None, None] * picture
        picture = torch.where(gallery.grey[which][:, None, None, None], tinted, picture)
        if pattern == GREY:
            picture = bin_to_sensor(picture, GREY, scale=1)[:, None]
        picture = picture * torch.from_numpy(drawn["brightness"]).to(device)[:, None, None, None]
        moves = {name: drawn[name][:, n] for name in ("velocity", "rotation", "zoom", "center", "acceleration")}
        mask = outline_masks(there("outline", n - 1), there("side", n), longest) if n else None
        layers.append(Layer(picture, Motion(**moves), drawn["position"][:, n], mask))
    return Scene(layers, side, side, clocks)


def see(light: Tensor, drawn: dict[str, np.ndarray], noise: SensorNoise | None) -> Tensor:
    """Return the spikes, uint8, of light (B, T, H, W), each clip with its share of the sensor noise.

    All random numbers but those of photons are drawn before, so they are the same on every device.
    """
    device = light.device

    def there(name: str) -> Tensor:
        return torch.from_numpy(drawn[name]).to(device, non_blocking=True)

    light = light * there("alpha")[:, None, None, None]
    if noise is None:
        return spike_integrate_fire(light, 1.0, there("charge"), dtype=torch.uint8)[0]
    share = there("noise")[:, None, None]
    if noise.photons is not None:
        light = _arrive(light, drawn, noise.photons, "photons")
    if noise.gain_spread:
        light = light * _around_one(there("gain"), noise.gain_spread * share)[:, None]
    if noise.dark_current:
        dark = (noise.dark_current * share * _around_one(there("dark"), noise.dark_spread))[:, None].expand_as(light)
        light = light + (dark if noise.photons is None else _arrive(dark, drawn, noise.photons, "electrons"))
    spikes, _ = spike_integrate_fire(light, 1.0, there("charge"), dtype=torch.uint8)
    if noise.hot or noise.dead:
        defects = there("defects")
        spikes.masked_fill_((defects < noise.hot * share)[:, None], 1)
        spikes.masked_fill_((defects >= 1 - noise.dead * share)[:, None], 0)
    return spikes


def _around_one(normal: Tensor, spread: Tensor | float) -> Tensor:
    """Return log-normal numbers with mean 1 and the standard deviation ``spread``, from normal ones."""
    variance = torch.as_tensor(spread, device=normal.device).square().log1p()
    return (variance.sqrt() * normal - variance / 2).exp()


def _arrive(light: Tensor, drawn: dict[str, np.ndarray], photons: float, purpose: str) -> Tensor:
    """Draw the charge (B, T, H, W) in whole electrons, with a seed for every clip."""
    generator = torch.Generator(light.device)
    arrived = []
    for clip, seed, share in zip(light, drawn[purpose].tolist(), drawn["noise"].tolist(), strict=True):
        in_threshold = photons / max(share, 1e-6)
        arrived.append(torch.poisson(clip * in_threshold, generator.manual_seed(seed)) / in_threshold)
    return torch.stack(arrived)

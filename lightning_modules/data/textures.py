"""Procedural textures, colourful and rich in fine detail, to complement a few photographs."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def outline_mask(size: int, rng: np.random.Generator) -> Tensor:
    """Draw a mask (size, size) of an ellipse, polygon or blob: 1 inside, 0 outside, with an edge one pixel wide."""
    middle = (size - 1) / 2
    y, x = np.mgrid[:size, :size] - middle
    angle, distance = np.arctan2(y, x), np.hypot(y, x)
    radius = outline(angle, rng)
    edge = max(middle - 0.5, 0.5)
    return torch.from_numpy((0.5 + radius / radius.max() * edge - distance).clip(0, 1).astype("float32"))


def outline(angle: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw an ellipse, polygon or blob, as its radius at angles in [-pi, pi]."""
    return [_ellipse, _polygon, _blob][rng.integers(3)](angle, rng)


def _ellipse(angle: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    ratio, turn = rng.uniform(0.4, 1), rng.uniform(0, np.pi)
    return ratio / np.hypot(ratio * np.cos(angle - turn), np.sin(angle - turn))


def _polygon(angle: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    count = rng.integers(3, 9)
    corners = (np.arange(count) + rng.uniform(-0.3, 0.3, count)) * 2 * np.pi / count + rng.uniform(0, 2 * np.pi)
    lengths = rng.uniform(0.5, 1, count)
    along = (angle - corners[0]) % (2 * np.pi)
    ends = np.append(corners - corners[0], 2 * np.pi)
    i = np.searchsorted(ends, along, side="right") - 1
    j = (i + 1) % count
    # the straight line between two corners, in polar coordinates
    sides = lengths[i] * np.sin(along - ends[i]) + lengths[j] * np.sin(ends[i + 1] - along)
    return lengths[i] * lengths[j] * np.sin(ends[i + 1] - ends[i]) / sides


def _blob(angle: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    radius = np.ones_like(angle)
    for k in range(2, 6):
        radius += rng.uniform(0, 0.5 / k) * np.cos(k * angle + rng.uniform(0, 2 * np.pi))
    return radius


def texture(height: int, width: int, rng: np.random.Generator) -> Tensor:
    """Draw ``rgb`` (3, height, width): coloured noise, gratings, checkers, or overlapping patches."""
    draw = [_noise, _gratings, _checkers, _patches, _patches][rng.integers(5)]
    return torch.from_numpy(draw(height, width, rng).clip(0, 1).astype("float32"))


def _colour(rng: np.random.Generator) -> np.ndarray:
    """Draw a colour, (3, 1, 1), mostly muted as in photographs, sometimes glaring."""
    return (rng.uniform(0, 1) + rng.exponential(0.15) * rng.standard_normal((3, 1, 1))).clip(0, 1)


def _ramp(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Map values in [0, 1] to a ramp between two random colours."""
    first, second = _colour(rng), _colour(rng)
    return first + (second - first) * values


def _noise(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """Draw coloured noise of a random frequency band, with correlated colours as in photographs."""
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width))
    finest = rng.uniform(0.05, 0.5)
    gain = np.exp(-((frequency / finest) ** 4)) / np.maximum(frequency, 0.01) ** rng.uniform(0.3, 1.6)
    gain[0, 0] = 0
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((3, height, width), "float32")) * gain, (height, width))
    field /= field.std() + 1e-6
    own = rng.uniform(0, 1) ** 2
    field = (1 - own) * field[:1] * rng.choice([-1.0, 1.0], (3, 1, 1), p=[0.05, 0.95]) + own * field
    return rng.uniform(0.3, 0.7, (3, 1, 1)) + rng.uniform(0.1, 0.4) * field


def _gratings(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """Draw stripes of random pitch and direction, straight or bent, smooth or square."""
    y, x = np.mgrid[:height, :width].astype("float32")
    picture = np.zeros((3, height, width), "float32")
    count = rng.integers(1, 4)
    for _ in range(count):
        turn, pitch = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(3), np.log(60)))
        along, across = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
        bend = rng.uniform(0, 20) * np.sin(across / rng.uniform(20, 200))
        wave = np.sin((along + bend) * 2 * np.pi / pitch + rng.uniform(0, 2 * np.pi))
        hardness = rng.choice([1.0, 3.0, pitch / 2])
        picture += _ramp(np.clip(0.5 + 0.5 * hardness * wave, 0, 1), rng)
    return picture / count


def _checkers(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """Draw a rotated checkerboard of two colours, with slightly different shades."""
    y, x = np.mgrid[:height, :width].astype("float32")
    turn, pitch = rng.uniform(0, np.pi / 2), np.exp(rng.uniform(np.log(4), np.log(40)))
    across = (x * np.cos(turn) + y * np.sin(turn)) / pitch + 1000
    down = (y * np.cos(turn) - x * np.sin(turn)) / pitch * rng.uniform(0.5, 2) + 1000
    wave = np.sin(np.pi * across) * np.sin(np.pi * down)
    board = np.clip(0.5 + wave * pitch / 2, 0, 1)
    shades = rng.uniform(0.7, 1, (64, 64))
    return _ramp(board, rng) * shades[down.astype(int) % 64, across.astype(int) % 64]


def _patches(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """Draw overlapping shapes, plain or textured, and lines of small bars like print."""
    picture = _ramp(np.linspace(0, 1, height * width).reshape(height, width), rng)
    side = (height + width) / 2
    for _ in range(rng.integers(20, 80)):
        if rng.uniform() < 0.15:
            _print(picture, rng)
            continue
        size = int(np.exp(rng.uniform(np.log(6), np.log(max(7.0, 0.6 * side)))))
        mask = outline_mask(size, rng).numpy()
        paint = _colour(rng)
        if size >= 16 and rng.uniform() < 0.3:
            paint = [_gratings, _checkers, _noise][rng.integers(3)](size, size, rng)
        top, left = rng.integers(-size // 2, height - size // 2), rng.integers(-size // 2, width - size // 2)
        rows, columns = slice(max(top, 0), top + size), slice(max(left, 0), left + size)
        under = picture[:, rows, columns]
        inside = (
            slice(max(-top, 0), max(-top, 0) + under.shape[1]),
            slice(max(-left, 0), max(-left, 0) + under.shape[2]),
        )
        under += mask[inside] * (np.broadcast_to(paint, (3, size, size))[(slice(None), *inside)] - under)
    return picture


def _print(picture: np.ndarray, rng: np.random.Generator) -> None:
    """Draw a line of letter-like strokes."""
    height, width = picture.shape[1:]
    letter, ink = int(rng.integers(5, 25)), _colour(rng)
    top, left = rng.integers(0, height), rng.integers(-width // 4, width)
    stroke = max(1, letter // 6)
    for start in range(left, min(left + letter * int(rng.integers(3, 30)), width), letter):
        for _ in range(rng.integers(2, 5)):
            y, x = top + rng.integers(0, letter), start + rng.integers(0, letter - stroke)
            tall = rng.uniform() < 0.5
            rows = slice(max(y, 0), max(y + (letter // 2 if tall else stroke), 0))
            columns = slice(max(x, 0), max(x + (stroke if tall else letter // 2), 0))
            picture[:, rows, columns] = ink

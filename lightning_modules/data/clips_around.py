"""Clips around key frames of a stream, of which every frame is read once and held no longer than it is needed."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import TypeVar

import torch
from torch import Tensor

Item = TypeVar("Item")


def clips_around(
    middles: Iterable[int],
    length: int,
    frames: Iterator[Tensor],
    first: int = 0,
    jump: Callable[[int], Iterator[Tensor]] | None = None,
) -> Iterator[tuple[int, Tensor]]:
    """Yield every key frame's number and clip, as soon as the clip's last frame has come.

    At most ``length`` frames are held, beside a clip.

    Args:
        middles: numbers of the key frames, increasing, the first of them ``length // 2`` behind ``first`` or later.
        length: frames of a clip.
        frames: the stream's frames (H, W), one after the other.
        first: number of the first of them.
        jump: gives the frames from a number on, where a stream can leave out those between two clips.

    Returns:
        An iterator over numbers and clips (length, H, W), which ends with the middles or with the stream.

    Example:
        >>> frames = iter(torch.arange(9.0).reshape(9, 1, 1))
        >>> [(middle, clip.flatten().tolist()) for middle, clip in clips_around([1, 4, 8], 3, frames)]
        [(1, [0.0, 1.0, 2.0]), (4, [3.0, 4.0, 5.0])]
    """
    held: deque[Tensor] = deque(maxlen=length)
    at = first
    for middle in middles:
        start = middle - length // 2
        if jump is not None and start > at:
            frames, at = jump(start), start
        while at < start + length:
            frame = next(frames, None)
            if frame is None:
                return
            held.append(frame)
            at += 1
        yield middle, torch.stack(tuple(held))


def film_groups(items: Iterable[Item], future: int = 0, interpolated: int = 0) -> Iterator[list[Item]]:
    """Yield the clips of a film, or what stands for them, group by group, each ending with a picture of the network.

    Args:
        items: of every picture, in order.
        future: key frames that a picture may wait for.
        interpolated: pictures between two that the network makes; there are none before the first.

    Example:
        >>> [*film_groups("abcdefg", interpolated=1)], [*film_groups("abcdefg", future=1, interpolated=1)]
        ([['a'], ['b', 'c'], ['d', 'e'], ['f', 'g']], [['a', 'b', 'c'], ['d', 'e', 'f', 'g']])
    """
    items, size = iter(items), (future + 1) * (interpolated + 1)
    group = list(islice(items, size - interpolated))
    while group:
        yield group
        group = list(islice(items, size))

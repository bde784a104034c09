"""Films: pictures from a stream of spikes, one after the other as it arrives."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import count
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lightning_modules.data.clips_around import clips_around, film_groups
from lightning_modules.inference.film_pictures import FilmPictures
from lightning_modules.inference.film_reader import check_future
from lightning_modules.networks import Network
from spikekit.check import check_planes, check_positive, check_whole
from spikekit.io.recording import white_rate


class FilmFrame(NamedTuple):
    """A picture of a film.

    Args:
        clock: number of the spike frame that it shows, counted from the beginning of the stream.
        rgb: (3, s H, s W), [0, 1].
    """

    clock: int
    rgb: Tensor


def film(
    network: Network,
    chunks: Iterable[Tensor],
    every: int = 20,
    *,
    future: int = 0,
    interpolated: int = 0,
    white: float | None = None,
    **how: Any,
) -> Iterator[FilmFrame]:
    r"""Yield the pictures of a stream as it arrives, from a recording or a live camera.

    Convention:
        The picture of clock n needs the clocks n - N // 2 to n + (N - 1) // 2, N being the network's frames, and is
        made as soon as the last of them has come. So a picture is (N - 1) // 2 clocks late, 20 of 41, which is a
        millisecond at 20 kHz; with chunks of c clocks up to c - 1 more, and by the time that the network takes. The
        first shows clock N // 2. N frames and the present chunk are held, however long the stream.

        A :class:`lightning_modules.networks.RecurrentCSCSR` carries on what it knows of the key frame before. With a
        ``future`` it makes pictures in groups of ``future + 1``, when the last of them has come: they are up to
        ``future * every`` clocks later, and better. A group is held meanwhile. With ``interpolated`` pictures between
        two of the network's, a group has ``interpolated + 1`` times as many pictures and ends with one of the
        network's. See :class:`lightning_modules.inference.film_pictures.FilmPictures`.

        White is the same in all pictures: ``white``, or else what 99.9 % of the pixels of the first clip do not exceed.

    Args:
        network: any of :mod:`lightning_modules.networks`, on the device of the chunks.
        chunks: spikes (T, H, W) of any lengths, such as :func:`spikekit.iter_spikes` reads with a ``chunk``; they begin
            with the network's Bayer phase.
        every: clocks between two pictures.
        future: key frames that a picture may wait for.
        interpolated: pictures between two that the network makes; these are moved there along the motion.
        white: spikes a clock of a pixel that is shown white.
        how: ``tile``, ``psnr_tolerance``, ``self_ensemble`` and ``static`` of
            :func:`lightning_modules.inference.predict.predict`; a network that carries on takes ``tile`` and
            ``static``.

    Returns:
        An iterator over pictures.

    Raises:
        TypeError: ``white`` is not a number; when iterated, a chunk that is not a tensor of real numbers.
        ValueError: an argument is out of range, or a ``future`` for a network that takes every clip by itself; when
            iterated, a chunk of another shape.

    Example:
        >>> import torch
        >>> from lightning_modules.networks import ClassicalDecoder
        >>> stream = (torch.rand(30, 8, 10) < 0.3 for _ in range(3))
        >>> [(clock, rgb.shape) for clock, rgb in film(ClassicalDecoder(scale=2), stream)]
        [(20, torch.Size([3, 16, 20])), (40, torch.Size([3, 16, 20])), (60, torch.Size([3, 16, 20]))]
    """
    check_whole("every", every)
    check_future(network, future)
    if white is not None:
        check_positive("white", white)
    static = how.pop("static", False)
    pictures = FilmPictures(network, interpolated, **how)
    clips = clips_around(count(network.frames // 2, every), network.frames, _frames(chunks))
    groups = film_groups(clips, future, interpolated)
    return _pictures(network.settings["alpha"], groups, white, partial(pictures, static=static))


def _pictures(
    alpha: float, groups: Iterable[list[tuple[int, Tensor]]], white: float | None, run: Callable[..., Tensor]
) -> Iterator[FilmFrame]:
    for group in groups:
        clocks, clips = [clock for clock, _ in group], torch.stack([clip for _, clip in group])
        if white is None:
            white = white_rate(clips[0].float().mean(0).cpu())
        for clock, rgb in zip(clocks, run(clips, clocks, exposure=alpha / white), strict=True):
            yield FilmFrame(clock, rgb.clone() if len(group) > 1 else rgb)  # who keeps one does not keep the group


def _frames(chunks: Iterable[Tensor]) -> Iterator[Tensor]:
    for chunk in chunks:
        check_planes("chunks", chunk, 3, "(T, H, W)")
        if chunk.ndim != 3:
            raise ValueError(f"chunks: expected (T, H, W), got {tuple(chunk.shape)}")
        yield from chunk

"""Films: the pictures of a stream of spikes, one after the other as it comes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import count
from typing import Any, NamedTuple

from torch import Tensor

from lightning_modules.data.clips_around import clips_around
from lightning_modules.inference.predict import predict
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
    white: float | None = None,
    **how: Any,
) -> Iterator[FilmFrame]:
    r"""Yield the pictures of a stream as it comes: a recording that is read on, or a camera at work.

    Convention:
        The picture of clock n needs the clocks n - N // 2 to n + (N - 1) // 2, N being the network's frames, and is
        made as soon as the last of them has come. So a picture is (N - 1) // 2 clocks late, 20 of 41, which is a
        millisecond at 20 kHz; with chunks of c clocks up to c - 1 more, and by the time that the network takes. The
        first shows clock N // 2. N frames and the present chunk are held, however long the stream.

        White is the same in all pictures: ``white``, or else what 99.9 % of the pixels of the first clip do not exceed.

    Args:
        network: any of :mod:`lightning_modules.networks`, on the device of the chunks.
        chunks: spikes (T, H, W) of any lengths, such as :func:`spikekit.iter_spikes` reads with a ``chunk``; they begin
            with the network's Bayer phase.
        every: clocks between two pictures.
        white: spikes a clock of a pixel that is shown white.
        how: ``tile``, ``psnr_tolerance``, ``self_ensemble`` and ``static`` of
            :func:`lightning_modules.inference.predict.predict`.

    Returns:
        An iterator over pictures.

    Raises:
        TypeError: ``every`` is not a whole number, ``white`` not a number; when iterated, a chunk that is not a tensor
            of real numbers.
        ValueError: one of them is out of range; when iterated, a chunk of another shape.

    Example:
        >>> import torch
        >>> from lightning_modules.networks import ClassicalDecoder
        >>> stream = (torch.rand(30, 8, 10) < 0.3 for _ in range(3))
        >>> [(clock, rgb.shape) for clock, rgb in film(ClassicalDecoder(scale=2), stream)]
        [(20, torch.Size([3, 16, 20])), (40, torch.Size([3, 16, 20])), (60, torch.Size([3, 16, 20]))]
    """
    every = check_whole("every", every)
    if white is not None:
        check_positive("white", white)
    return _pictures(network, chunks, every, white, how)


def _pictures(
    network: Network, chunks: Iterable[Tensor], every: int, white: float | None, how: dict[str, Any]
) -> Iterator[FilmFrame]:
    length, alpha = network.frames, network.settings["alpha"]
    for clock, clip in clips_around(count(length // 2, every), length, _frames(chunks)):
        if white is None:
            white = white_rate(clip.float().mean(0).cpu())
        yield FilmFrame(clock, predict(network, clip[None], exposure=alpha / white, **how)[0])


def _frames(chunks: Iterable[Tensor]) -> Iterator[Tensor]:
    for chunk in chunks:
        check_planes("chunks", chunk, 3, "(T, H, W)")
        if chunk.ndim != 3:
            raise ValueError(f"chunks: expected (T, H, W), got {tuple(chunk.shape)}")
        yield from chunk

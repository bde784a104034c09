"""Decoding of streams that do not fit in memory, chunk by chunk."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import torch
from torch import Tensor

from spikekit.check import check_index, check_planes


def decode_in_chunks(decode: Callable[[Tensor], Tensor], chunks: Iterable[Tensor], overlap: int) -> Iterator[Tensor]:
    r"""Decode a stream that arrives in chunks, in bounded memory, with the result of decoding it at once.

    Convention:
        Every frame is decoded with at least ``overlap`` frames before and after it, as far as the recording has them.
        The concatenated pieces therefore equal ``decode`` of the whole stream wherever frame n of the result depends
        only on the frames n - overlap .. n + overlap and on the ends of the recording:

        * :func:`spikekit.tfp`: everywhere, with an overlap of ``window // 2``;
        * :func:`spikekit.tfi` and :func:`spikekit.spike_interval`: at every pixel and frame n for which the frames
          n - overlap .. n + overlap contain the last spike before n and the first at or after n. If the recording has
          none on one side, these frames must reach its end there, and contain the two nearest spikes of the other side,
          or all there are. This holds everywhere if no pixel is silent for ``overlap // 2`` consecutive frames. A pixel
          that is silent for longer is decoded as if the recording ended with the frames in memory.

        Pieces are as long as the chunks allow, and at least as long as the overlap, except the last. At most two thirds
        of the work is done twice. At most 3 overlap + 1 chunk frames are held.

    Args:
        decode: a function of spikes :math:`(*, T, H, W)`, such as ``tfi`` or ``lambda spikes: tfp(spikes, 41)``, or of
            packed ones; it keeps the number of frames.
        chunks: chunks :math:`(*, T_i, H, W)`, of any lengths, such as :func:`spikekit.iter_spikes` reads.
        overlap: frames of context on each side, 0 or more.

    Returns:
        An iterator over consecutive pieces of the result; together they have as many frames as the chunks.

    Raises:
        TypeError: ``overlap`` is not a whole number; on iteration, a chunk is not a tensor of real numbers, or
            ``decode`` does not return a tensor.
        ValueError: ``overlap`` is below 0; on iteration, a chunk is empty, chunks differ in size, dtype or device, or
            ``decode`` changes the number of frames.

    Example:
        >>> from spikekit import tfp
        >>> spikes = (torch.rand(100, 3, 7) < 0.3).to(torch.uint8)
        >>> pieces = decode_in_chunks(lambda part: tfp(part, 11), spikes.split(30), overlap=5)
        >>> torch.cat(list(pieces)).equal(tfp(spikes, 11))
        True

    Reference:
        The overlap-save method of convolution.
    """
    overlap = check_index("overlap", overlap)
    if overlap < 0:
        raise ValueError(f"overlap: expected 0 or more frames, got {overlap}")
    return _pieces(decode, chunks, overlap)


def _pieces(decode: Callable[[Tensor], Tensor], chunks: Iterable[Tensor], overlap: int) -> Iterator[Tensor]:
    held: list[Tensor] = []
    length = past = 0  # frames held, and how many of them are already decoded
    for chunk in chunks:
        check_planes("chunks", chunk, 3, "(*, T, H, W)")
        kinds = [((*part.shape[:-3], "T", *part.shape[-2:]), part.dtype, part.device) for part in (*held[:1], chunk)]
        if kinds[0] != kinds[-1]:
            raise ValueError(f"chunks: expected all of one size, type and device, got {kinds[0]} before {kinds[1]}")
        held.append(chunk)
        length += chunk.shape[-3]
        ready = length - past - overlap
        if ready < max(overlap, 1):
            continue
        span = torch.cat(held, dim=-3)
        piece = _decoded(decode, span, past, ready)
        kept = min(overlap, past + ready)
        held = [span[..., past + ready - kept :, :, :].clone()]  # a view would keep the whole span
        del span
        length, past = held[0].shape[-3], kept
        yield piece
    if length > past:
        yield _decoded(decode, torch.cat(held, dim=-3), past, length - past)


def _decoded(decode: Callable[[Tensor], Tensor], span: Tensor, past: int, count: int) -> Tensor:
    result = decode(span)
    if not isinstance(result, Tensor):
        raise TypeError(f"decode: expected a function that returns a tensor, got {type(result).__name__}")
    if result.ndim < 3 or result.shape[-3] != span.shape[-3]:
        raise ValueError(f"decode: expected {span.shape[-3]} frames, as many as given, got {tuple(result.shape)}")
    return result[..., past : past + count, :, :]

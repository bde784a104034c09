"""Decoding in chunks of any length equals decoding the whole, in bounded memory."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from spikekit import spike_interval, tfi, tfp
from spikekit.decoders.chunked import decode_in_chunks

SEEDS = st.integers(0, 2**31)
CUTS = st.lists(st.integers(1, 30), min_size=1, max_size=12)


def stream(frames, rate, seed):
    """Random pixels with rates up to ``rate``, some silent and some always firing."""
    generator = torch.Generator().manual_seed(seed)
    rates = rate * torch.rand(2, 5, generator=generator)
    rates[0, 0], rates[1, 4] = 0, 1
    return (torch.rand(frames, 2, 5, generator=generator) < rates).to(torch.uint8)


def in_chunks(decode, spikes, cuts, overlap):
    pieces = list(decode_in_chunks(decode, spikes.split(cuts, dim=-3), overlap))
    assert all(piece.shape[-3] >= max(overlap, 1) for piece in pieces[:-1])
    return torch.cat(pieces, dim=-3)


@given(CUTS, st.sampled_from([1, 3, 11, 41]), st.floats(0, 1), SEEDS)
def test_tfp_in_chunks_equals_that_of_the_whole(cuts, window, rate, seed):
    spikes = stream(sum(cuts), rate, seed).reshape(1, -1, 2, 5).half()
    got = in_chunks(lambda part: tfp(part, window), spikes, cuts, window // 2)
    assert got.equal(tfp(spikes, window))


def decided(spikes, overlap):
    """Return where the frames n - overlap .. n + overlap determine the interval at n."""
    frames = len(spikes)
    result = torch.zeros(spikes.shape, dtype=torch.bool)
    for y, x in [(y, x) for y in range(spikes.shape[1]) for x in range(spikes.shape[2])]:
        fired = spikes[:, y, x].nonzero().flatten().tolist()
        for n in range(frames):
            low, high = n - overlap, n + overlap
            before, after = [k for k in fired if k < n][::-1], [k for k in fired if k >= n]
            if before and after:
                result[n, y, x] = before[0] >= low and after[0] <= high
            else:
                ends = (before or low <= 0) and (after or high >= frames - 1)
                result[n, y, x] = bool(ends) and all(low <= k <= high for k in (before or after)[:2])
    return result


@given(CUTS, st.integers(0, 30), st.floats(0, 1), SEEDS)
def test_tfi_in_chunks_equals_that_of_the_whole(cuts, overlap, rate, seed):
    """The result is exact wherever the docstring promises it."""
    spikes = stream(sum(cuts), rate, seed)
    exact = decided(spikes, overlap)
    got, whole = in_chunks(spike_interval, spikes, cuts, overlap), spike_interval(spikes)
    assert got[exact].equal(whole[exact])
    got, whole = in_chunks(tfi, spikes, cuts, overlap), tfi(spikes)
    assert got[exact].equal(whole[exact])


def test_pieces_are_returned_as_early_as_possible():
    """Chunks are not read ahead, and pieces are not returned before their context is known."""
    read = []

    def chunks():
        for n in range(6):
            read.append(n)
            yield torch.ones(10, 1, 1)

    pieces = decode_in_chunks(lambda part: part, chunks(), 5)
    assert read == []
    lengths = []
    for piece in pieces:
        lengths.append((read[-1], len(piece)))
    assert lengths == [(0, 5), (1, 10), (2, 10), (3, 10), (4, 10), (5, 10), (5, 5)]


@pytest.mark.parametrize(
    ("chunks", "overlap", "decode", "error", "message"),
    [
        ([], -1, tfi, ValueError, "overlap: expected 0 or more frames, got -1"),
        ([torch.ones(3, 4)], 2, tfi, ValueError, r"chunks: expected a non-empty tensor of shape \(\*, T, H, W\)"),
        ([torch.ones(3, 4, 5), torch.ones(3, 5, 4)], 2, tfi, ValueError, r"one size.*4, 5\).*before .*5, 4\)"),
        ([torch.ones(3, 4, 5), torch.ones(3, 4, 5).bool()], 2, tfi, ValueError, "type.*torch.float32.*torch.bool"),
        (
            [torch.ones(7, 4, 5)],
            2,
            lambda part: part[:1],
            ValueError,
            "decode: expected 7 frames, as many as given, got",
        ),
        ([torch.ones(7, 4, 5)], 2, lambda _: None, TypeError, "decode: expected a function that returns a tensor"),
    ],
)
def test_bad_arguments_are_rejected(chunks, overlap, decode, error, message):
    with pytest.raises(error, match=message):
        list(decode_in_chunks(decode, chunks, overlap))

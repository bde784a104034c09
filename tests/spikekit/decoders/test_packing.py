"""Packed spikes: bits by hand, round trips of every dtype and width, the torch path, and errors."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from spikekit.decoders.packing import _pack_bits, _unpack_bits, pack_spikes, unpack_spikes

DTYPES = [torch.bool, torch.uint8, torch.int8, torch.int64, torch.float16, torch.bfloat16, torch.float32, torch.float64]


def random_spikes(*shape):
    return (torch.rand(shape) < 0.4).to(torch.uint8)


def packed_by_hand(spikes):
    """Pack one pixel at a time."""
    rows = spikes.reshape(-1, spikes.shape[-1]).tolist()
    packed = [[sum(bit << i for i, bit in enumerate(row[j : j + 8])) for j in range(0, len(row), 8)] for row in rows]
    return torch.tensor(packed, dtype=torch.uint8).reshape(*spikes.shape[:-1], -1)


@given(
    st.sampled_from([(1, 1), (3, 4), (2, 3, 5), (2, 1, 3, 2)]),
    st.integers(1, 25),
    st.sampled_from(DTYPES),
    st.booleans(),
)
def test_bytes_equal_those_of_one_pixel_at_a_time(lead, width, dtype, strided):
    spikes = random_spikes(*lead, width).to(dtype)
    if strided:
        spikes = spikes.mT.contiguous().mT
    packed = pack_spikes(spikes)
    assert packed.dtype is torch.uint8
    assert packed.equal(packed_by_hand(spikes.byte()))
    unpacked = unpack_spikes(packed, width, dtype=dtype)
    assert unpacked.dtype is dtype
    assert unpacked.equal(spikes)


@pytest.mark.parametrize("width", [1, 7, 8, 9, 24])
def test_torch_path_gives_the_same_bytes(width):
    """The torch path, which runs on devices other than the CPU."""
    spikes = random_spikes(2, 3, 4, width)
    packed = packed_by_hand(spikes)
    assert _pack_bits._init_fn(spikes.float()).equal(packed)
    assert _unpack_bits._init_fn(packed, width).equal(spikes)
    with pytest.raises(ValueError, match="zeros and ones"):
        _pack_bits._init_fn(2 * spikes)


@pytest.mark.parametrize("value", [2, -1, 0.5, float("nan"), float("inf")])
def test_values_other_than_0_and_1_are_rejected(value):
    for dtype in (torch.float32, torch.bfloat16, torch.float64, *([torch.uint8] if value == 2 else [])):
        with pytest.raises(ValueError, match="expected zeros and ones"):
            pack_spikes(torch.tensor([[0, 1, value]], dtype=dtype))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: unpack_spikes(torch.zeros(3, 2), 16), TypeError, "packed: expected bytes, torch.uint8, got torch.fl"),
        (lambda: unpack_spikes(torch.zeros(3, 2).byte(), 17), ValueError, r"width: expected 9 \.\. 16 .* got 17"),
        (lambda: unpack_spikes(torch.zeros(3, 2).byte(), 9, dtype="int8"), TypeError, r"to\(\)"),
    ],
)
def test_bad_arguments_are_rejected(call, error, message):
    with pytest.raises(error, match=message):
        call()


@pytest.mark.parametrize("axis", [0, 1, 3])
def test_vmap_gives_the_same_bytes(capfd, axis):
    spikes = random_spikes(3, 5, 4, 13)
    packed = pack_spikes(spikes)
    assert torch.func.vmap(pack_spikes, axis)(spikes.movedim(0, axis)).equal(packed)
    unpack = torch.func.vmap(lambda one: unpack_spikes(one, 13), axis)
    assert unpack(packed.movedim(0, axis)).equal(spikes)
    assert capfd.readouterr().err == ""  # without a rule of its own vmap loops, and says so


def test_compiled_packing_gives_the_same_bytes():
    spikes = random_spikes(2, 5, 4, 13)
    torch.compiler.reset()
    both = torch.compile(lambda bits: unpack_spikes(pack_spikes(bits), 13), fullgraph=True, backend="aot_eager")
    assert both(spikes).equal(spikes)

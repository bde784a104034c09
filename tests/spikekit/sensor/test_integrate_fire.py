"""The sensor against a loop, and properties of its charge."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from spikekit import spike_integrate_fire

DTYPES = [torch.float64, torch.float32, torch.bfloat16, torch.float16]


def loop(light, threshold, charge):
    """Integrate and fire in the dtype of ``charge``, by the definition."""
    threshold = charge.dtype.type(threshold)
    spikes, charge = np.zeros_like(light), charge.copy()
    for where in np.ndindex(charge.shape):
        for t in range(light.shape[-3]):
            here = (*where[:-2], t, *where[-2:])
            u = charge[where] + light[here].astype(charge.dtype)
            whole = np.floor(u / threshold)
            spikes[here] = whole > 0
            charge[where] = max(u - whole * threshold, 0)
    return spikes, charge


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("threshold", [0.3, 1, 7])
@pytest.mark.parametrize("most", [0.2, 5])
@pytest.mark.parametrize("lead", [(), (2, 1)])
def test_spikes_and_charge_equal_those_of_a_loop(dtype, threshold, most, lead):
    rng = np.random.default_rng(0)
    light = (rng.random((*lead, 17, 3, 2)) * most * threshold).astype(dtype)
    start = (rng.random((*lead, 3, 2)) * threshold * 0.99).astype(dtype)
    for charge in (None, start):
        spikes, left = spike_integrate_fire(
            torch.from_numpy(light), threshold, None if charge is None else torch.from_numpy(charge)
        )
        expected = loop(light, threshold, np.zeros_like(start) if charge is None else charge)
        assert spikes.dtype == left.dtype == torch.from_numpy(light).dtype
        assert np.array_equal(spikes.numpy(), expected[0])
        assert np.array_equal(left.numpy(), expected[1])


@given(
    light=st.lists(st.integers(0, 128), min_size=1, max_size=41),
    start=st.integers(0, 127),
    threshold=st.sampled_from([0.5, 1.0, 8.0]),
    dtype=st.sampled_from(DTYPES),
)
def test_charge_is_conserved(light, start, threshold, dtype):
    # 128ths of the threshold: exact in every dtype
    light = torch.tensor(light, dtype=torch.float64).reshape(-1, 1, 1) / 128 * threshold
    start = torch.full((1, 1), start / 128 * threshold)
    spikes, charge = spike_integrate_fire(light.to(dtype), threshold, start)
    assert threshold * spikes.double().sum() + charge.double().sum() == start.double().sum() + light.sum()
    assert (charge >= 0).all()
    assert (charge < threshold).all()


@pytest.mark.parametrize("dtype", [torch.uint8, torch.bool, torch.float16, torch.float64])
def test_dtype_of_the_spikes(dtype):
    light = torch.rand(2, 9, 3, 4, requires_grad=True)
    expected, charge = spike_integrate_fire(light)
    spikes, left = spike_integrate_fire(light, dtype=dtype)
    assert spikes.dtype == dtype
    assert torch.equal(spikes, expected.to(dtype))
    assert torch.equal(left, charge)
    assert spikes.requires_grad == dtype.is_floating_point


def test_second_gradient_is_the_same_mask():
    """The gradient is linear in the incoming gradient, so its own gradient is the same mask."""
    light = (torch.rand(3, 2, 2, dtype=torch.float64) * 3 - 1).requires_grad_()
    weight = torch.randn(3, 2, 2, dtype=torch.float64, requires_grad=True)
    spikes, _ = spike_integrate_fire(light, 0.5)
    (grad,) = torch.autograd.grad((spikes * weight).sum(), light, create_graph=True)
    (again,) = torch.autograd.grad(grad.sum(), weight)
    assert torch.equal(again, 2.0 * ((light >= 0) & (light <= 0.5)))


@given(data=st.data(), threshold=st.sampled_from([0.3, 1.0, 7.0]), dtype=st.sampled_from(DTYPES))
def test_chunks_equal_one_run(data, threshold, dtype):
    frames = data.draw(st.integers(1, 20))
    cuts = sorted(data.draw(st.lists(st.integers(1, frames), max_size=4)))
    light = (torch.rand(2, frames, 2, 3) * 2 * threshold).to(dtype)
    spikes, charge = spike_integrate_fire(light, threshold)
    parts, left = [], None
    for begin, end in zip([0, *cuts], [*cuts, frames], strict=True):
        if begin < end:
            part, left = spike_integrate_fire(light[:, begin:end], threshold, left)
            parts.append(part)
    assert torch.equal(torch.cat(parts, dim=1), spikes)
    assert torch.equal(left, charge)


def test_initial_charge_gets_no_gradient():
    light = torch.rand(4, 2, 2, requires_grad=True)
    start = torch.rand(2, 2, requires_grad=True)
    spikes, charge = spike_integrate_fire(light, charge=start)
    assert not charge.requires_grad
    spikes.sum().backward()
    assert start.grad is None or (start.grad == 0).all()
    assert torch.equal(light.grad, torch.ones_like(light))


@pytest.mark.parametrize(
    ("error", "arguments"),
    [
        (ValueError, (torch.ones(3, 2, 2), 0)),
        (ValueError, (torch.ones(3, 2, 2), 1e-60)),  # 0 in float32: dark pixels would fire
        (ValueError, (torch.ones(3, 2, 2), 1e60)),
        (ValueError, (torch.ones(3, 2, 2), 1.0, torch.ones(3, 2))),
        (ValueError, (torch.ones(3, 2, 2), 1.0, torch.ones(5, 2, 2))),
        (TypeError, (torch.ones(3, 2, 2), 1.0, torch.ones(2, 2, dtype=torch.int64))),
        (TypeError, (torch.ones(3, 2, 2), 1.0, None, torch.int16)),
    ],
)
def test_invalid_arguments_are_rejected(error, arguments):
    *positional, dtype = arguments if len(arguments) == 4 else (*arguments, None)
    with pytest.raises(error):
        spike_integrate_fire(*positional, dtype=dtype)

"""The three bilinear operators against loops in float64, for every path, layout and dtype."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from spikekit.kernels import cpu_warp
from spikekit.kernels.layout import is_channels_last
from spikekit.warp.gather import Dot, Gather, Scatter, weighted_dot, weighted_gather, weighted_scatter

OPERATORS = [weighted_gather, weighted_scatter, weighted_dot]
PIXELS, POINTS = 11, 7
FLOATS = [torch.float64, torch.float32, torch.bfloat16, torch.float16]


@pytest.fixture(params=["torch path", "one piece", "pieces"], autouse=True)
def path(request, monkeypatch, without_kernels):
    if request.param == "pieces":
        monkeypatch.setattr(cpu_warp, "_pieces", lambda length, width: (slice(i, i + 3) for i in range(0, length, 3)))
    with without_kernels(*OPERATORS) if request.param == "torch path" else nullcontext():
        yield


def draw(batch, channels, bags, dtype=torch.float64, last=False):
    """Values, a gradient, indices and weights; the index omits some pixels and repeats others."""

    def planes(size):
        if last:
            return torch.randn(batch, size, channels, dtype=torch.float64).to(dtype).transpose(1, 2)
        return torch.randn(batch, channels, size, dtype=torch.float64).to(dtype)

    wide = torch.promote_types(dtype, torch.float32)
    index = torch.randint(2, PIXELS - 1, (batch, bags, POINTS))
    return planes(PIXELS), planes(POINTS), index, torch.rand(batch, bags, POINTS, dtype=wide)


def loops(values, grad, index, weight):
    """Gather, scatter and dot by their definition, in float64."""
    values, grad, index, weight = (np.asarray(a.double()) for a in (values, grad, index, weight))
    gathered, scattered, dots = np.zeros(grad.shape), np.zeros(values.shape), np.zeros(weight.shape)
    for b, k, q in np.ndindex(weight.shape):
        p = int(index[b, k, q])
        gathered[b, :, q] += weight[b, k, q] * values[b, :, p]
        scattered[b, :, p] += weight[b, k, q] * grad[b, :, q]
        dots[b, k, q] = values[b, :, p] @ grad[b, :, q]
    return [torch.from_numpy(a) for a in (gathered, scattered, dots)]


def results(values, grad, index, weight):
    return (
        weighted_gather(values, index, weight),
        weighted_scatter(grad, index, weight, PIXELS),
        weighted_dot(values, grad, index),
    )


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize(("batch", "channels", "bags"), [(1, 1, 1), (3, 2, 4), (2, 20, 4), (0, 9, 4)])
def test_weighted_sums_equal_those_of_loops(batch, channels, bags, last, dtype):
    values, grad, index, weight = draw(batch, channels, bags, dtype, last)
    got = results(values, grad, index, weight)
    wide = torch.promote_types(dtype, torch.float32)
    assert [a.dtype for a in got] == [dtype, dtype, wide]
    for one, expected in zip(got, loops(values, grad, index, weight), strict=True):
        eps = max(torch.finfo(one.dtype).eps, 1e-14)
        torch.testing.assert_close(one.double(), expected, rtol=2 * eps, atol=50 * torch.finfo(wide).eps)


@pytest.mark.parametrize("channels", [1, 2, 9])
@pytest.mark.parametrize("last", [False, True])
def test_result_has_the_memory_layout_of_the_values(channels, last):
    """On every path, as promised to the compiler, which would misread another layout."""
    values, grad, index, weight = draw(2, channels, 4, last=last)
    gathered, scattered, _ = results(values, grad, index, weight)
    for got in (gathered, scattered):
        assert is_channels_last(got) == (last and channels > 1)
    for op, args in [
        (weighted_gather, (values, index, weight)),
        (weighted_scatter, (grad, index, weight, PIXELS)),
        (weighted_dot, (values, grad, index)),
    ]:
        torch.library.opcheck(op, args, test_utils=("test_schema", "test_faketensor", "test_aot_dispatch_dynamic"))


@pytest.mark.parametrize("channels", [2, 9])
def test_each_operator_is_the_derivative_of_the_others(channels):
    values, grad, index, weight = draw(1, channels, 3)
    for tensor in (values, grad, weight):
        tensor.requires_grad_()
    for function, args in [
        (Gather.apply, (values, index, weight)),
        (lambda *a: Scatter.apply(*a, PIXELS), (grad, index, weight)),
        (Dot.apply, (values, grad, index)),
    ]:
        assert gradcheck(function, args)
        assert gradgradcheck(function, args, fast_mode=True)  # what is linear in each is wrong in a random direction

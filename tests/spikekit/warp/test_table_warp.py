"""The warp by a table in one go, against the search and the gather that it replaces."""

import sys

import pytest
import torch

from spikekit import bayer_mask, flow_warp_idw
from spikekit.warp import table_warp
from spikekit.warp.neighbors import idw_neighbors
from spikekit.warp.table_warp import table_unwarp, warp_by_table

pytest.importorskip("numba", reason="Numba is not installed")

MASKS = [
    *bayer_mask(4, 6, "RGGB", scale=3, dtype=torch.bool),
    bayer_mask(5, 7, "GBRG", dtype=torch.bool)[1],
    torch.ones(9, 4, dtype=torch.bool),
]


def flows(mask, count=3, dtype=torch.float32):
    """Of several pixels, far beyond the borders, halfway between the positions of tables, and not finite."""
    flow = 4 * torch.randn(count, 2, *mask.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    flow[0] = (flow[0] * 32).round() / 32
    flow[1] *= 100
    flow[1, :, 0] = torch.tensor([float("nan"), float("inf"), float("-inf"), 1e30]).repeat(5)[: mask.shape[1]]
    return flow.to(dtype)


@pytest.fixture
def plain(monkeypatch):
    """Call something without Numba."""

    def call(function, *args, **options):
        with monkeypatch.context() as without:
            without.setattr("spikekit.kernels.loops.NUMBA", False)
            return function(*args, **options)

    return call


@pytest.mark.parametrize("mask", MASKS)
@pytest.mark.parametrize("steps", [2, 6, 10, 16])
@pytest.mark.parametrize(("neighbors", "channels"), [(4, 2), (1, 1), (3, 9)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_as_without_numba(mask, steps, neighbors, channels, dtype, plain):
    features = torch.randn(3, channels, *mask.shape).to(dtype)
    args = features, flows(mask, dtype=dtype), mask
    expected = plain(flow_warp_idw, *args, neighbors=neighbors, steps=steps)
    got = flow_warp_idw(*args, neighbors=neighbors, steps=steps)
    assert got.dtype == dtype
    torch.testing.assert_close(got, expected, rtol=1e-6 if dtype is not torch.bfloat16 else 1e-2, atol=1e-6)


def test_numba_is_what_runs(monkeypatch):
    from spikekit.kernels import cpu_table

    called = []
    for name in ("warp", "unwarp"):
        loop = getattr(cpu_table, name)
        monkeypatch.setattr(cpu_table, name, lambda *args, name=name, loop=loop: called.append(name) or loop(*args))
    features = torch.randn(1, 2, 12, 18, requires_grad=True)
    flow_warp_idw(features, torch.zeros(1, 2, 12, 18), MASKS[0], steps=4).sum().backward()
    assert called == ["warp", "unwarp"]


def test_numba_that_cannot_be_imported(monkeypatch, plain):
    """Numba refuses a NumPy that is newer than it knows."""
    args = torch.randn(3, 2, *MASKS[0].shape), flows(MASKS[0]), MASKS[0]
    expected = plain(flow_warp_idw, *args, steps=16)
    monkeypatch.setitem(sys.modules, "spikekit.kernels.cpu_table", None)
    assert torch.equal(flow_warp_idw(*args, steps=16), expected)


@pytest.mark.parametrize("mask", MASKS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_transpose(mask, dtype):
    """<W v, g> = <v, W' g>, in the sums of a dense matrix."""
    flow, generator = flows(mask, dtype=dtype), torch.Generator().manual_seed(2)
    values, grad = torch.randn(2, 3, 2, mask.numel(), dtype=dtype, generator=generator)
    index, weight = idw_neighbors(flow, mask, 4, 16)
    matrix = torch.zeros(3, mask.numel(), mask.numel(), dtype=torch.float64)
    for one, indices, weights in zip(matrix, index, weight, strict=True):
        for pixels, shares in zip(indices, weights, strict=True):
            one[torch.arange(mask.numel()), pixels] += shares.double()
    warped = warp_by_table(values, flow, mask, 4, 16).double()
    torch.testing.assert_close(warped, values.double() @ matrix.mT, rtol=1e-5, atol=1e-5)
    back = table_unwarp(grad, flow, mask, 4, 16).double()
    torch.testing.assert_close(back, grad.double() @ matrix, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("mask", MASKS[:2])
def test_derivatives_as_without_numba(mask, plain):
    """The first in features and flow, and the second."""
    features = torch.randn(3, 2, *mask.shape, dtype=torch.float64, requires_grad=True)
    flow = flows(mask, dtype=torch.float64).requires_grad_()

    def derivatives():
        warped = flow_warp_idw(features, flow, mask, steps=16)
        first = torch.autograd.grad(warped.square().sum(), (features, flow), create_graph=True)
        return *first, *torch.autograd.grad(sum(part.sin().sum() for part in first), (features, flow))

    for got, expected in zip(derivatives(), plain(derivatives), strict=True):
        assert got.isfinite().all()
        torch.testing.assert_close(got, expected)


def test_threads_share_images_and_rows(plain):
    mask = bayer_mask(65, 70, scale=2, dtype=torch.bool)[2]
    features, flow = torch.randn(5, 2, 130, 140, requires_grad=True), torch.randn(5, 2, 130, 140)

    def both():
        warped = flow_warp_idw(features, flow, mask, steps=16)
        return warped, *torch.autograd.grad(warped.square().sum(), features)

    before = torch.get_num_threads()
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            for got, expected in zip(both(), plain(both), strict=True):
                torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-5)
    finally:
        torch.set_num_threads(before)


def test_memory_of_any_order():
    """Transposed, expanded, channels last: which the result of a warp is, too."""
    mask = MASKS[0]
    features, flow = torch.randn(2, 3, 18, 12).mT, torch.randn(1, 2, 18, 12).mT.expand(2, -1, -1, -1)
    expected = flow_warp_idw(features.contiguous(), flow.contiguous(), mask, steps=4)
    torch.testing.assert_close(flow_warp_idw(features, flow, mask, steps=4), expected)
    last = features.contiguous(memory_format=torch.channels_last)
    warped = flow_warp_idw(last, flow, mask, steps=4)
    assert warped.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(warped, expected)


def test_registration():
    flow, values = torch.randn(2, 2, 12, 18, dtype=torch.float64), torch.randn(2, 3, 12 * 18, dtype=torch.float64)
    for op in (table_warp.table_warp, table_unwarp):
        torch.library.opcheck(
            op,
            (values, flow, MASKS[0], 4, 4),
            test_utils=("test_schema", "test_faketensor", "test_aot_dispatch_dynamic"),
        )


def test_by_torch_func_and_compiled():
    mask = MASKS[1]
    features, flow = torch.randn(3, 2, 2, *mask.shape), torch.randn(3, 2, 2, *mask.shape)

    def energy(flow, features):
        return flow_warp_idw(features, flow, mask, steps=16).square().sum()

    leaves = flow.clone().requires_grad_(), features.clone().requires_grad_()
    expected = torch.autograd.grad(energy(*leaves), leaves)
    for got in (
        torch.func.vmap(torch.func.grad(energy, (0, 1)))(flow, features),
        torch.func.grad(lambda *args: torch.func.vmap(energy)(*args).sum(), (0, 1))(flow, features),
        torch.autograd.grad(torch.compile(energy, backend="aot_eager", fullgraph=True)(*leaves), leaves),
    ):
        torch.testing.assert_close(got, expected)

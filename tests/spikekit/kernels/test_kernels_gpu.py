"""The GPU kernels: in Triton's interpreter on the CPU, compiled without a GPU, and on a GPU if there is one.

Triton decides when it is imported whether it interprets, so that the tests of what kernels compute run in a process of
their own: :func:`test_in_the_triton_interpreter`. Where there is a GPU they run on it as well.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from spikekit import bayer_mask
from spikekit.flow import tvl1
from spikekit.kernels.layout import is_channels_last
from spikekit.warp import gather, neighbors, site_search

triton = pytest.importorskip("triton", reason="triton is not installed")
from spikekit.kernels import gpu  # noqa: E402

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
DEVICE = "cpu" if INTERPRETED else "cuda"
computes = pytest.mark.skipif(
    not INTERPRETED and not torch.cuda.is_available(), reason="no GPU; see test_in_the_triton_interpreter"
)
FLOATS = [torch.float64, torch.float32, torch.bfloat16, torch.float16]


def version(package):
    return tuple(map(int, package.__version__.split(".")[:2]))


@pytest.mark.skipif(INTERPRETED, reason="this is the interpreter")
def test_in_the_triton_interpreter():
    if version(triton) < (3, 7) and version(np) >= (2, 4):
        pytest.skip("the interpreter of this Triton does not know this NumPy")
    files = [Path(__file__).with_name(name) for name in ("test_kernels.py", "test_kernels_gpu.py")]
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--durations=9", *files],
        env={**os.environ, "TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert "passed" in run.stdout


def call(name, *args):
    """Run a kernel on the device, and return its results on the CPU."""
    results = getattr(gpu, name)(*[a.to(DEVICE) if isinstance(a, torch.Tensor) else a for a in args])
    return tuple(r.cpu() for r in results) if isinstance(results, tuple) else results.cpu()


def known_pixels():
    one, some = torch.zeros(5, 3, dtype=torch.bool), torch.tensor([[0, 1, 0, 0, 1], [1, 0, 0, 0, 0], [0, 1, 0, 1, 1]])
    one[4, 1] = True
    green = bayer_mask(6, 8, dtype=torch.bool)[1]
    return {"green": (green, 4), "some": (some > 0, 6), "one": (one, 4), "the nearest": (green, 1)}


@computes
@pytest.mark.parametrize(("which", "dtype"), [*((w, FLOATS[0]) for w in known_pixels()), ("green", FLOATS[1])])
def test_nearest_pixels_equal_those_of_the_torch_path(which, dtype):
    """For zero, whole, half, arbitrary and very large flow."""
    mask, count = known_pixels()[which]
    unit = 64  # in these units all positions are whole numbers, so that ties are exact
    steps = ((0, 1), (3, unit), (3, unit // 2), (3, 1), (10000, unit // 4))
    flow = [
        torch.randint(-most * unit // step, most * unit // step + 1, (2, *mask.shape)) * step for most, step in steps
    ]
    flow = (torch.stack(flow) / unit).to(dtype)
    tables = [tuple(table.to(DEVICE) for table in product) for product in neighbors.products_of(mask, count)]
    index, weight = call("nearest_known", flow, tables, count)
    expected = neighbors._nearest_known(flow, mask, count)
    assert torch.equal(index, expected[0])
    torch.testing.assert_close(weight, expected[1], rtol=4 * torch.finfo(dtype).eps, atol=0)


GATHERS = [(1, 1, 1, 1, 1), (2, 3, 10, 4, 7), (2, 11, 30, 5, 150), (1, 70, 13, 2, 40)]  # B, C, P, K, Q


def gathering(sizes, dtype, last=False):
    """Arguments of the three operators; ``last`` for channels-last layout."""
    batch, channels, size, count, points = sizes
    values, grad = (torch.randn(batch, channels, length).to(dtype) for length in (size, points))
    if last:
        values, grad = values.mT.contiguous().mT, grad.mT.contiguous().mT
    weight = torch.rand(batch, count, points).to(torch.promote_types(dtype, torch.float32))
    return values, grad, torch.randint(0, size, (batch, count, points)), weight


@computes
@pytest.mark.parametrize(("sizes", "dtype"), [*((s, FLOATS[1]) for s in GATHERS), *((GATHERS[1], d) for d in FLOATS)])
@pytest.mark.parametrize("last", [False, True])
def test_weighted_sums_equal_the_torch_path(sizes, dtype, last):
    values, grad, index, weight = gathering(sizes, dtype, last)
    for name, args in (
        ("gather", (values, index, weight)),
        ("scatter", (grad, index, weight, sizes[2])),
        ("dot", (values, grad, index)),
        ("gather", (values[:1].expand(sizes[0], -1, -1), index[:1].expand(sizes[0], -1, -1), weight)),
        ("gather", (values[:0], index[:0], weight[:0])),
        ("scatter", (grad[:0], index[:0], weight[:0], sizes[2])),
        ("dot", (values[:0], grad[:0], index[:0])),
    ):
        got, expected = call(f"weighted_{name}", *args), getattr(gather, f"_{name}")(*args)
        eps = max(torch.finfo(dtype).eps, 2**-7 if INTERPRETED and dtype is torch.bfloat16 else 0)
        torch.testing.assert_close(got, expected, rtol=2 * eps, atol=1e-13 if dtype is FLOATS[0] else 1e-5)
        if name != "dot":
            assert is_channels_last(got) == is_channels_last(args[0])


@computes
def test_atomic_sums_are_not_used_in_deterministic_mode():
    _, grad, index, weight = gathering(GATHERS[1], torch.float32)
    torch.use_deterministic_algorithms(True)
    try:
        assert gpu.weighted_scatter(grad, index, weight, 10) is NotImplemented
    finally:
        torch.use_deterministic_algorithms(False)


@computes
@pytest.mark.parametrize(("scale", "channels", "size"), [(4, 2, (6, 7)), (1, 3, (7, 6))])
def test_site_wise_search_and_its_derivative_equal_the_torch_path(scale, channels, size):
    table = site_search.site_table("RGGB", 1, scale, (size[0] % 2 == 1, size[1] % 2 == 1), torch.device("cpu"))
    shares = torch.tensor([[0.25, 0.0], [0.0, 1.0]])
    flow = torch.randn(1, 2, 2, *size) * 3
    flow[0, 0, 0, 3, 4] = 2.0**30
    features = torch.randn(1, 2, channels, *size)
    expected = site_search._search_sites(features, flow, shares, *table.arguments)
    got = call("search_sites", features, flow, shares, *table.arguments)
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-5)
    grad = torch.randn_like(expected)
    expected = site_search._spread_sites(grad, flow, shares, *table.arguments)
    got = call("spread_sites", grad, flow, shares, *table.arguments)
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-4)


@computes
def test_a_level_of_tvl1_equals_the_torch_path():
    """Compared with the torch path in float32, up to the order of sums."""
    clips, height, width = 2, 5, 9
    smooth = torch.nn.functional.avg_pool2d(torch.rand(clips, 3, height + 8, width + 8), 9, 1)
    pictures = torch.cat([smooth[:, :1], smooth[:, :1].roll((1, 1), (2, 3)) + 0.01 * smooth[:, 1:2]], dim=1)
    times, limit = torch.tensor([[-0.5, 0.5], [0.0, 1.0]]), 20 * smooth[:, 2]
    flow = torch.randn(clips, 2, height, width)
    constants = tvl1.ROUNDS, tvl1.SMOOTHINGS, tvl1.STEP, tvl1.STEP / tvl1.COUPLING
    expected = tvl1.refine(pictures, times, limit, flow, 1)
    got = call("tvl1_level", pictures, times, limit, flow, 1, *constants)
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-3)


def compile_calls():
    """Every kernel with every dtype, and sizes that Triton specialises on."""
    stream = torch.zeros(2, 3, 4, 8)
    for x, dtype in [*((stream, d) for d in FLOATS[:3]), (torch.zeros(1, 1, 1, 1), torch.float32)]:
        wide, x = torch.promote_types(dtype, torch.float32), x.to(dtype)
        yield "integrate_fire", x, 0.3, x[..., 0, :, :].to(wide), dtype
        yield "tfi", x > 0, 1.0, dtype
        yield "tfp", x > 0, 3, 1.0, dtype
        yield "tfp_grad", x, 3, 1.0, dtype
    yield "integrate_fire", stream, 0.3, stream[..., 0, :, :], torch.bool
    for dtype in (torch.uint8, torch.int64, torch.float16):
        yield "spike_interval", stream.to(dtype)
        yield "tfi", stream.to(dtype), 1.0, torch.uint8
        yield "tfp", stream.to(dtype), 3, 1.0, torch.uint8
    yield "spike_interval", torch.zeros(32767, 1, 1)
    tables = [(torch.zeros(3, 8, dtype=torch.int32), torch.zeros(4, 16, dtype=torch.int32))] * 2
    for wide in FLOATS[:2]:
        yield "nearest_known", torch.zeros(1, 2, 4, 8, dtype=wide), tables, 4
    for dtype, last in zip(FLOATS, (False, True, False, True), strict=True):
        values, grad, index, weight = gathering((1, 64, 32, 4, 32), dtype, last)
        yield "weighted_gather", values, index, weight
        yield "weighted_scatter", grad, index, weight, 32
        yield "weighted_dot", values, grad, index


class Machine:
    """A stand-in for Triton's description of a GPU."""

    def get_current_target(self):
        from triton.backends.compiler import GPUTarget

        return GPUTarget("cuda", 80, 32)

    def get_current_device(self):
        return 0

    def get_current_stream(self, device):
        return 0


@pytest.mark.slow
@pytest.mark.skipif(INTERPRETED or torch.cuda.is_available(), reason="only where Triton has no GPU to compile for")
def test_compiled_kernels_round_every_operation(monkeypatch, tmp_path):
    """No product is fused with a sum, and no quotient is approximate."""
    texts = []

    def compile_only(kernel, grid):
        return lambda *args, **options: texts.append(kernel.warmup(*args, grid=grid, **options).asm.get("ptx", ""))

    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(triton.JITFunction, "__getitem__", compile_only)
    driver = triton.runtime.driver
    before = vars(driver).copy()
    driver.set_active(Machine())
    try:
        for name, *args in compile_calls():
            getattr(gpu, name)(*args)
    finally:
        vars(driver).clear()
        vars(driver).update(before)
    assert len(texts) > 40
    for text in texts:
        assert not re.search(r"\bfma\.rn\.f|\bdiv\.(full|approx)", text)

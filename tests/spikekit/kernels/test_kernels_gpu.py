"""The GPU kernels: by Triton's interpreter on the CPU, compiled where there is no GPU, and on a GPU where there is one.

Triton decides when it is imported whether it interprets, so that the tests of what kernels compute run in a process of
their own: :func:`test_by_the_interpreter`. Where there is a GPU they run on it as well.
"""

import os
import re
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
import torch

from spikekit.decoders import dense as decoders
from spikekit.flow import tvl1
from spikekit.kernels.layout import is_channels_last
from spikekit.sensor import integrate_fire as sensor
from spikekit.warp import site_search, warp

triton = pytest.importorskip("triton", reason="triton is not installed")
from spikekit.kernels import gpu  # noqa: E402

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
DEVICE = "cpu" if INTERPRETED else "cuda"
computes = pytest.mark.skipif(
    not INTERPRETED and not torch.cuda.is_available(), reason="no GPU; test_by_the_interpreter runs it on the CPU"
)
FLOATS = [torch.float64, torch.float32, torch.bfloat16, torch.float16]
SPIKES = [torch.bool, torch.uint8, torch.int8, torch.int16, torch.int64, *FLOATS]
SHAPES = [(1, 1, 1), (2, 2, 3, 3, 4), (5, 23, 29)]  # 23 * 29 pixels are more than a block


def types(every, shape, first=True):
    """All of them in the largest shape, with the first of other options; the interpreter is slow."""
    return every if (shape == SHAPES[-1] and first) or not INTERPRETED else every[:1]


def version(package):
    return tuple(map(int, package.__version__.split(".")[:2]))


@pytest.mark.skipif(INTERPRETED, reason="this is the interpreter")
def test_by_the_interpreter():
    if version(triton) < (3, 7) and version(np) >= (2, 4):
        pytest.skip("the interpreter of this Triton does not know this NumPy")
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", __file__],
        env={**os.environ, "TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert "passed" in run.stdout


def call(name, *args):
    """Run a kernel on the device, and bring its results back."""
    results = getattr(gpu, name)(*[a.to(DEVICE) if isinstance(a, torch.Tensor) else a for a in args])
    return tuple(r.cpu() for r in results) if isinstance(results, tuple) else results.cpu()


def check(got, expected, **tolerance):
    """Equal bit for bit unless told otherwise; the interpreter cuts bfloat16 instead of rounding it."""
    if INTERPRETED and got.dtype is torch.bfloat16 and not tolerance:
        tolerance = {"rtol": 2**-7, "atol": 0}
    torch.testing.assert_close(got, expected, **(tolerance or {"rtol": 0, "atol": 0}), equal_nan=True)


def random_light(shape, dtype, threshold, most=2.5):
    light = torch.rand(shape, dtype=torch.float64) * most * threshold
    whole = torch.rand(shape) < 0.2
    return torch.where(whole, (light / threshold).round() * threshold, light).to(dtype)


def random_spikes(shape, dtype):
    """Pixels of every density, silent ones and ones that always fire among them."""
    density = torch.rand((*shape[:-3], 1, *shape[-2:])) * 1.4 - 0.2
    return (torch.rand(shape) < density).to(dtype)


def pixels(*streams):
    """Yield the index of every pixel, without time, as an index of whole streams."""
    shape = streams[0].shape
    for where in np.ndindex(*shape[:-3], *shape[-2:]):
        yield (*where[:-2], slice(None), *where[-2:])


def fire_loop(light, threshold, charge):
    """The contract, clock by clock, in the dtype of the charge."""
    light, spikes, left = light.numpy(), np.zeros(light.shape), charge.clone().numpy()
    theta = left.dtype.type(threshold)
    for where in pixels(light):
        rest = left[where[:-3] + where[-2:]]
        for t in range(light.shape[-3]):
            full = rest + light[where][t].astype(theta.dtype)
            spikes[where][t] = full >= theta
            rest = full - theta if full >= theta else full
            if rest >= theta:
                rest = full - np.floor(full / theta) * theta
                rest = rest if 0 <= rest < theta else theta.dtype.type(0)
        left[where[:-3] + where[-2:]] = rest
    return torch.from_numpy(spikes), torch.from_numpy(left)


@computes
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("dtype", "wide"), [(d, w) for w in FLOATS[:2] for d in FLOATS if d.itemsize <= w.itemsize])
def test_integrate_fire(shape, dtype, wide):
    threshold = 0.3 if dtype.itemsize > 2 else 7.0
    light = random_light(shape, dtype, threshold)
    charge = torch.rand(shape[:-3] + shape[-2:], dtype=wide) * threshold * 0.99
    expected = sensor._integrate_fire._init_fn(light, threshold, charge, dtype)
    for out in (dtype, torch.bool):
        spikes, left = call("integrate_fire", light, threshold, charge, out)
        assert spikes.dtype is out
        check(spikes, expected[0].to(out))
        check(left, expected[1])
    if dtype is not torch.bfloat16:  # which NumPy has not
        spikes, left = fire_loop(light, threshold, charge)
        check(expected[0].double(), spikes)
        check(expected[1], left)


@computes
@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("wide", [torch.float64, torch.float32])
def test_extreme_light(wide):
    inf, nan = float("inf"), float("nan")
    theta = torch.tensor(0.3, dtype=wide).item()
    below = torch.nextafter(torch.tensor(theta, dtype=wide), torch.tensor(0.0, dtype=wide)).item()
    streams = [
        [0, 0, 0, 0], [theta] * 4, [below] * 4, [1e-12] * 4, [0, 0, 30, 30], [-1, 0.3, 1, 1], [nan, 1, 1, 1],
        [0.2, inf, 0.2, 0.2], [0.2, -inf, inf, 1], [1e30, 1, 1e-30, 0.3], [1.2, 0.9, 0.6, 0.3],
        [0.3e6] * 4, [0, 0, 0, 5036367.5], [0, 0, 0, 50865],  # in float32 the remainder is above theta, or below 0
    ]  # fmt: skip
    light = torch.tensor(streams, dtype=wide).T.reshape(4, 2, 7)
    charge = torch.zeros(2, 7, dtype=wide)
    got = call("integrate_fire", light, 0.3, charge, wide)
    for other in (sensor._integrate_fire._init_fn(light, 0.3, charge, wide), fire_loop(light, 0.3, charge)):
        check(got[0], other[0].to(wide))
        check(got[1], other[1])


@computes
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("dtype", "of_grad"), [(d, d) for d in FLOATS] + [(torch.float64, torch.float32)])
def test_integrate_fire_grad(shape, dtype, of_grad):
    light = random_light(shape, dtype, 0.3)
    light.view(-1)[: 5 : light.numel()] = float("nan")
    light[torch.rand(shape) < 0.2] -= 0.3
    light[torch.rand(shape) < 0.1] = float("inf")
    any_grad = torch.randn(shape, dtype=torch.float64).to(of_grad)
    for grad in (any_grad, any_grad[..., :1, :].expand(shape)):
        got = call("integrate_fire_grad", grad, light, 0.3)
        check(got, sensor._integrate_fire_grad._init_fn(grad, light, 0.3))
        theta = torch.tensor(0.3, dtype=torch.promote_types(dtype, torch.float32)).double()
        linear = (light.double() >= 0) & (light.double() <= theta)
        expected = torch.where(linear, grad.double() / theta, 0).to(of_grad)
        check(got, expected, rtol=2 * torch.finfo(of_grad).eps, atol=0)


def interval_loop(fired):
    """Eq. (4) of the contract, with its estimates at the ends."""
    frames, times = len(fired), np.flatnonzero(fired)
    gaps = np.diff(times)
    result = []
    for n in range(frames):
        before, after = times[times < n], times[times >= n]
        observed = (after[0] if len(after) else frames) - (before[-1] if len(before) else -1)
        if len(gaps) and not len(before):
            observed = max(observed, gaps[0])
        if len(gaps) and not len(after):
            observed = max(observed, gaps[-1])
        result.append(observed)
    return result


def of_pixels(function, *streams):
    """Apply a function of the streams of one pixel to every pixel."""
    arrays = [s.double().numpy() for s in streams]
    result = np.zeros(arrays[0].shape)
    for where in pixels(*arrays):
        result[where] = function(*(a[where] for a in arrays))
    return torch.from_numpy(result)


@computes
@pytest.mark.parametrize("shape", SHAPES)
def test_spike_interval(shape):
    spikes = random_spikes(shape, torch.bool)
    expected = of_pixels(interval_loop, spikes)
    for dtype in types(SPIKES, shape):
        got = call("spike_interval", spikes.to(dtype))
        assert got.dtype is torch.int16
        check(got.double(), expected)
    assert torch.equal(got, decoders._spike_interval._init_fn(spikes))


@computes
def test_any_value_but_0_is_a_spike():
    spikes = torch.tensor([0.0, -0.0, 1e-45, float("nan"), -2.0, 0.0]).reshape(6, 1, 1)
    check(call("spike_interval", spikes), decoders._spike_interval._init_fn(spikes != 0))
    large = torch.tensor([0, 2**40, 0]).reshape(3, 1, 1)
    assert call("spike_interval", large).flatten().tolist() == [2, 2, 2]


@computes
def test_long_clips(monkeypatch):
    """A frame takes the interpreter two milliseconds: it sees a shorter clip, with the same types."""
    for frames, dtype in ((32766, torch.int16), (32767, torch.int32)):
        assert call("spike_interval", torch.zeros(0, frames, 1, 1)).dtype is dtype
    frames = 32767
    if INTERPRETED:
        frames = 600
        monkeypatch.setattr(gpu, "_LONGEST", frames - 1)
    spikes = torch.zeros(frames, 1, 3, dtype=torch.uint8)
    spikes[0, 0, 1] = spikes[-1, 0, 1] = 1
    spikes[:, 0, 2] = torch.rand(frames) < 0.01
    got = call("spike_interval", spikes)
    assert got.dtype is torch.int32
    check(got, decoders._spike_interval._init_fn(spikes).int())
    assert got[0, 0].tolist()[:2] == [frames + 1, frames - 1]


@computes
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("max_range", [255.0, 0.1])
def test_tfi(shape, max_range):
    spikes = random_spikes(shape, torch.uint8)
    exact = max_range / of_pixels(interval_loop, spikes)
    for out in types(FLOATS, shape, max_range == 0.1):
        got = call("tfi", spikes, max_range, out)
        check(got, decoders._tfi._init_fn(spikes, max_range, out))
        check(got.double(), exact, rtol=2 * torch.finfo(out).eps, atol=0)
    for dtype in types(SPIKES, shape, max_range == 0.1):
        check(call("tfi", spikes.to(dtype), max_range, torch.float32), exact.float(), rtol=1.2e-7, atol=0)
    check(call("tfi", spikes, max_range, torch.uint8), decoders._tfi._init_fn(spikes, max_range, torch.uint8))


def spread_loop(grad, fired, rate):
    ends = [-1, *np.flatnonzero(fired), len(fired) - 1]
    result = np.zeros(len(fired))
    for begin, end in pairwise(ends):
        result[begin + 1 : end + 1] = grad[begin + 1 : end + 1].sum()
    return result * rate


@computes
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("dtype", "of_grad"), [(d, d) for d in FLOATS] + [(torch.float32, torch.float64), (torch.float64, torch.float32)]
)
def test_tfi_grad(shape, dtype, of_grad):
    spikes = random_spikes(shape, dtype)
    any_grad, rate = torch.randn(shape).to(of_grad), torch.rand(shape).to(of_grad)
    for grad in (any_grad, any_grad[..., :1, :].expand(shape)):
        got = call("tfi_grad", grad, spikes, rate)
        check(got, decoders._tfi_grad._init_fn(grad, spikes, rate))
        eps = torch.finfo(dtype).eps
        exact = of_pixels(spread_loop, grad, spikes, rate)
        check(got.double(), exact, rtol=2 * eps, atol=1e-5 if eps > 1e-10 else 1e-13)


def window_loop(values, window, max_range, adjoint=False):
    frames, half = len(values), window // 2
    n = np.arange(frames)
    mean = np.abs(n[:, None] - n) <= half
    mean = max_range * mean / mean.sum(axis=1, keepdims=True)
    return (mean.T if adjoint else mean) @ values


@computes
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("window", "max_range"), [(3, 1.0), (2**40 + 1, 255.0)])
def test_tfp(shape, window, max_range):
    spikes = random_spikes(shape, torch.uint8)
    exact = of_pixels(lambda stream: window_loop(stream, window, max_range), spikes)
    for out in (torch.uint8, *types([*FLOATS[1:], FLOATS[0]], shape, window == 3)):
        check(call("tfp", spikes, window, max_range, out), decoders._tfp._init_fn(spikes, window, max_range, out))
    for dtype in types(SPIKES, shape, window == 3):
        got = call("tfp", spikes.to(dtype), window, max_range, torch.float32)
        check(got, exact.float(), rtol=2.4e-7, atol=0)
    check(call("tfp", spikes.double(), window, max_range, torch.float64), exact, rtol=1e-15, atol=0)


@computes
def test_tfp_of_any_numbers():
    values = torch.randn(41, 3, 5, dtype=torch.float64)
    exact = of_pixels(lambda stream: window_loop(stream, 7, 2.0), values)
    check(call("tfp", values, 7, 2.0, torch.float64), exact, rtol=1e-12, atol=1e-12)
    check(call("tfp", values.float(), 7, 2.0, torch.float32), exact.float(), rtol=1e-6, atol=1e-6)
    large = torch.full((5, 1, 1), 255, dtype=torch.uint8)
    check(call("tfp", large, 3, 1.0, torch.float32), torch.full((5, 1, 1), 255.0))
    whole = torch.randint(-(2**33), 2**33, (9, 1, 2))
    exact = of_pixels(lambda stream: window_loop(stream, 3, 1.0), whole)
    check(call("tfp", whole, 3, 1.0, torch.float64), exact, rtol=1e-15, atol=0)


@computes
@pytest.mark.parametrize(
    ("shape", "dtype"), [*((s, FLOATS[0]) for s in SHAPES), *((SHAPES[-1], d) for d in FLOATS[1:])]
)
@pytest.mark.parametrize("window", [5, 99])
def test_tfp_grad(shape, window, dtype):
    any_grad = torch.randn(shape).to(dtype)
    for grad in (any_grad, any_grad[..., :1, :].expand(shape)):
        got = call("tfp_grad", grad, window, 3.0, dtype)
        exact = of_pixels(lambda stream: window_loop(stream, window, 3.0, adjoint=True), grad)
        eps = torch.finfo(dtype).eps
        check(got, exact.to(dtype), rtol=2 * eps, atol=1e-14 if eps < 1e-10 else 1e-7)


STREAM_OPS = {
    "integrate_fire": lambda x: call("integrate_fire", x, 0.6, x[..., 0, :, :].float(), torch.uint8)[0],
    "charge": lambda x: call("integrate_fire", x, 0.6, x[..., 0, :, :].float(), torch.uint8)[1].unsqueeze(-3),
    "integrate_fire_grad": lambda x: call("integrate_fire_grad", x, x, 0.6),
    "spike_interval": lambda x: call("spike_interval", x.round()),
    "tfi": lambda x: call("tfi", x.round(), 1.0, torch.float16),
    "tfi_grad": lambda x: call("tfi_grad", x, x.round(), x),
    "tfp": lambda x: call("tfp", x, 3, 1.0, torch.float16),
    "tfp_grad": lambda x: call("tfp_grad", x, 3, 1.0, torch.float32),
}


@computes
@pytest.mark.parametrize("name", STREAM_OPS)
def test_layouts_of_streams(name):
    op, x = STREAM_OPS[name], torch.rand(2, 9, 5, 4)
    expected = op(x)
    for order in ([3, 2, 1, 0], [0, 1, 3, 2], [1, 2, 3, 0], [2, 3, 0, 1]):
        inverse = [order.index(i) for i in range(4)]
        view = x.permute(order).contiguous().permute(inverse)
        got = op(view)
        check(got, expected)
        if name != "charge":
            assert got.stride() == torch.empty_like(view).stride()
    frame = x[:, :1].expand(2, 9, 5, 4)
    check(op(frame), op(frame.contiguous()))
    assert op(frame).stride() == op(frame.contiguous()).stride()
    wider = torch.rand(2, 9, 5, 8)
    check(op(wider[..., 1::2]), op(wider[..., 1::2].contiguous()))
    check(op(x[0]), expected[0])
    assert op(x[:0]).shape == expected[:0].shape


def products(mask, neighbors):
    """The tables that ``nearest_known`` searches, written from what they mean."""

    def table(known, length):
        order = [sorted(known, key=lambda p: (abs(2 * p - h), p))[:neighbors] for h in range(2 * length)]
        return torch.tensor(order, dtype=torch.int32).T.contiguous().to(DEVICE)

    patterns = {}
    for row, pattern in enumerate(mask.tolist()):
        patterns.setdefault(tuple(pattern), []).append(row)
    return [
        (table(rows, mask.shape[0]), table(np.flatnonzero(pattern).tolist(), mask.shape[1]))
        for pattern, rows in patterns.items()
        if any(pattern)
    ]


def known_pixels():
    bayer = torch.zeros(6, 8, dtype=torch.bool)
    bayer[::2, ::2] = True
    green = bayer | bayer.roll((1, 1), (0, 1))
    corner = torch.zeros(5, 3, dtype=torch.bool)
    corner[4, 1] = True
    return {"red": bayer, "green": green, "any": torch.rand(4, 7) < 0.3, "one": corner, "all": torch.ones(1, 9) > 0}


@computes
@pytest.mark.parametrize(
    ("which", "neighbors", "dtype"),
    [
        *((which, 4, torch.float64) for which in known_pixels()),
        *((which, neighbors, torch.float64) for which in ("any", "one") for neighbors in (1, 6)),
        ("green", 4, torch.float32),
    ],
)
def test_nearest_known(which, neighbors, dtype):
    mask = known_pixels()[which]
    height, width = mask.shape
    unit = 64  # in these units all positions are whole numbers, so that ties are exact

    def draw(most, step):
        return torch.randint(-most * unit // step, most * unit // step + 1, (2, height, width)) * step

    # none, whole, half, any, far outside
    flow = torch.stack([draw(0, 1), draw(3, unit), draw(3, unit // 2), draw(3, 1), draw(10000, unit // 4)])
    index, weight = call("nearest_known", (flow / unit).to(dtype), products(mask, neighbors), neighbors)
    assert index.dtype is torch.int64
    assert weight.dtype is dtype
    rows, columns = np.nonzero(mask.numpy())
    indices, shares = [], []
    for n, y, x in np.ndindex(len(flow), height, width):
        moved_x, moved_y = (flow[n, :, y, x] + torch.tensor([x, y]) * unit).tolist()
        square = (columns * unit - moved_x) ** 2 + (rows * unit - moved_y) ** 2
        nearest = np.argsort(square, kind="stable")[:neighbors]
        missing = neighbors - len(nearest)
        with np.errstate(divide="ignore"):
            share = 1 / np.sqrt(square[nearest]) if square[nearest[0]] else 1.0 * (nearest == nearest[0])
        flat = rows[nearest] * width + columns[nearest]
        indices.append([*flat, *[flat[0]] * missing])
        shares.append([*share / share.sum(), *[0] * missing])
    assert index.mT.flatten(0, 1).tolist() == indices
    expected = torch.tensor(shares, dtype=torch.float64)
    check(weight.mT.flatten(0, 1).double(), expected, rtol=4 * torch.finfo(dtype).eps, atol=0)


GATHERS = [(1, 1, 1, 1, 1), (2, 3, 10, 4, 7), (2, 11, 30, 5, 150), (1, 70, 13, 2, 40)]  # B, C, P, K, Q


def gathering(sizes, dtype, of_weight):
    """Arguments of the three operators, and the matrix (B, Q, P) that they multiply with."""
    batch, channels, size, neighbors, points = sizes
    values = torch.randn(batch, channels, size).to(dtype)
    grad = torch.randn(batch, channels, points).to(dtype)
    index = torch.randint(0, size, (batch, neighbors, points))
    weight = torch.rand(batch, neighbors, points).to(of_weight)
    matrix = torch.zeros(batch, points, size, dtype=torch.float64)
    matrix.scatter_add_(2, index.mT, weight.double().mT)
    return values, grad, index, weight, matrix


def near(dtype):
    eps = max(torch.finfo(dtype).eps, torch.finfo(torch.float32).eps if dtype is not torch.float64 else 0)
    return {"rtol": 2 * eps, "atol": 16 * torch.finfo(torch.float64 if dtype is torch.float64 else torch.float32).eps}


@computes
@pytest.mark.parametrize("sizes", GATHERS)
@pytest.mark.parametrize(
    ("dtype", "of_weight"),
    [(torch.float64, torch.float64), *[(d, torch.float32) for d in FLOATS[1:]], (torch.float32, torch.float64)],
)
@pytest.mark.parametrize("last", [False, True])
def test_weighted(sizes, dtype, of_weight, last):
    if INTERPRETED and sizes != GATHERS[1] and (dtype, of_weight) != (torch.float32, torch.float32):
        pytest.skip("the interpreter is slow, and types are the same in all sizes")
    values, grad, index, weight, matrix = gathering(sizes, dtype, of_weight)
    if last:  # channels next to each other in memory
        values, grad = values.mT.contiguous().mT, grad.mT.contiguous().mT
    gathered = call("weighted_gather", values, index, weight)
    check(gathered, (values.double() @ matrix.mT).to(dtype), **near(dtype))
    scattered = call("weighted_scatter", grad, index, weight, values.shape[2])
    check(scattered, (grad.double() @ matrix).to(dtype), rtol=near(dtype)["rtol"], atol=1e-5)
    for got, like in ((gathered, values), (scattered, grad)):
        assert is_channels_last(got) == is_channels_last(like)
        assert is_channels_last(got) or got.is_contiguous()
    dots = call("weighted_dot", values, grad, index)
    pairs = values.double().mT @ grad.double()  # (B, P, Q)
    wide = torch.promote_types(dtype, torch.float32)
    check(dots, pairs.gather(1, index).to(wide), rtol=1e-5 if wide is torch.float32 else 1e-13, atol=1e-5)


@computes
def test_weighted_edges():
    values, grad, index, weight, _ = gathering((2, 3, 10, 4, 7), torch.float32, torch.float32)
    expected = call("weighted_gather", values[:1].expand(2, -1, -1), index, weight)
    check(expected, call("weighted_gather", values[:1].repeat(2, 1, 1), index, weight))
    of_one = index[:1].expand(2, -1, -1), weight.mT.contiguous().mT
    check(call("weighted_gather", values, *of_one), call("weighted_gather", values, *(a.contiguous() for a in of_one)))
    assert call("weighted_gather", values[:0], index[:0], weight[:0]).shape == (0, 3, 7)
    assert call("weighted_scatter", grad[:0], index[:0], weight[:0], 10).shape == (0, 3, 10)
    assert call("weighted_dot", values[:0], grad[:0], index[:0]).shape == (0, 4, 7)
    torch.use_deterministic_algorithms(True)
    try:
        assert gpu.weighted_scatter(grad, index, weight, 10) is NotImplemented
    finally:
        torch.use_deterministic_algorithms(False)


on_a_gpu = pytest.mark.skipif(not torch.cuda.is_available() or INTERPRETED, reason="no GPU")


@on_a_gpu
@pytest.mark.parametrize("dtype", FLOATS)
def test_sensor_and_decoders_on_the_gpu(dtype):
    """The operators find their kernels: forward and backward as on the CPU."""
    light = random_light((2, 17, 33, 35), dtype, 0.6)
    results = {}
    for device in ("cpu", "cuda"):
        leaf = light.to(device).requires_grad_()
        spikes, charge = sensor.spike_integrate_fire(leaf, 0.6)
        rates = decoders.tfi(spikes, 255.0), decoders.tfp(spikes, 5)
        grads = [torch.autograd.grad(r.sum(), leaf, retain_graph=True)[0] for r in (spikes, *rates)]
        results[device] = [r.detach().cpu() for r in (spikes, charge, decoders.spike_interval(spikes), *rates, *grads)]
    for ours, reference in zip(results["cuda"], results["cpu"], strict=True):
        check(ours, reference, rtol=4 * torch.finfo(dtype).eps, atol=1e-5)


@on_a_gpu
@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
@pytest.mark.parametrize("neighbors", [1, 4])
@pytest.mark.parametrize("deterministic", [False, True])
def test_warp_on_the_gpu(dtype, layout, neighbors, deterministic):
    mask = (torch.rand(13, 17) < 0.3) | torch.eye(13, 17, dtype=torch.bool)
    features, flow = torch.randn(2, 5, 13, 17).to(dtype), (torch.randn(2, 2, 13, 17) * 3).to(dtype)
    results = {}
    torch.use_deterministic_algorithms(deterministic)
    try:
        for device in ("cpu", "cuda"):
            leaves = [a.to(device).to(memory_format=layout).requires_grad_() for a in (features, flow)]
            warped = warp.flow_warp_idw(*leaves, mask.to(device), neighbors=neighbors)
            assert warped.is_contiguous(memory_format=layout)
            grads = torch.autograd.grad((warped * warped).sum(), leaves)
            results[device] = [r.detach().cpu() for r in (warped, *grads)]
    finally:
        torch.use_deterministic_algorithms(False)
    for ours, reference in zip(results["cuda"], results["cpu"], strict=True):
        eps = torch.finfo(dtype).eps
        check(ours, reference, rtol=16 * eps, atol=max(16 * eps, 1e-4 if dtype is torch.float32 else 0))


def compile_calls():
    """Every kernel, every type of its arguments, sizes that Triton specialises on and others."""
    stream = torch.zeros(2, 3, 4, 8)
    for x in (stream, torch.zeros(1, 1, 1, 5), torch.zeros(1, 1, 1, 1)):
        planes = x[..., 0, :, :]
        for dtype in FLOATS if x is stream else FLOATS[1:2]:  # what Triton makes of a size, it makes of any type
            wide = torch.promote_types(dtype, torch.float32)
            yield "integrate_fire", x.to(dtype), 0.3, planes.to(wide), dtype
            yield "integrate_fire_grad", x.to(dtype), x.to(dtype), 0.3
            yield "tfi_grad", x.to(dtype), x.to(dtype), x.to(dtype)
            yield "tfi", x > 0, 1.0, dtype
            yield "tfp", x > 0, 3, 1.0, dtype
            yield "tfp_grad", x.to(dtype), 3, 1.0, dtype
        yield "integrate_fire", x, 0.3, planes, torch.bool
    for dtype in SPIKES:
        yield "spike_interval", stream.to(dtype)
        yield "tfi", stream.to(dtype), 1.0, torch.uint8
        yield "tfp", stream.to(dtype), 3, 1.0, torch.uint8
    yield "spike_interval", torch.zeros(32767, 1, 1)
    yield "spike_interval", torch.zeros(1, 1, 1, 5).expand(1, 4, 8, 5).permute(0, 2, 3, 1)
    yield "integrate_fire_grad", stream.double(), stream, 0.3
    tables = [(torch.zeros(3, 8, dtype=torch.int32), torch.zeros(4, 16, dtype=torch.int32))] * 2
    for wide in FLOATS[:2]:
        yield "nearest_known", torch.zeros(1, 2, 4, 8, dtype=wide), tables, 4
    for sizes in ((1, 64, 32, 4, 32), (2, 3, 10, 4, 7), (1, 1, 1, 1, 1)):
        for dtype in FLOATS if sizes[1] == 64 else FLOATS[1:2]:
            values, grad, index, weight, _ = gathering(sizes, dtype, torch.promote_types(dtype, torch.float32))
            for a, b in ((values, grad), (values.mT.contiguous().mT, grad.mT.contiguous().mT)):
                yield "weighted_gather", a, index, weight
                yield "weighted_scatter", b, index, weight, sizes[2]
                yield "weighted_dot", a, b, index


class Machine:
    """A GPU that is not there, as Triton's driver describes it."""

    def __init__(self, *target):
        self.target = target

    def get_current_target(self):
        from triton.backends.compiler import GPUTarget

        return GPUTarget(*self.target)

    def get_current_device(self):
        return 0

    def get_current_stream(self, device):
        return 0


@pytest.mark.slow
@pytest.mark.skipif(INTERPRETED or torch.cuda.is_available(), reason="only where Triton has no GPU to compile for")
@pytest.mark.parametrize("target", [("cuda", 80, 32), ("hip", "gfx942", 64)], ids=["cuda", "rocm"])
def test_compiles(target, monkeypatch, tmp_path):
    """On CUDA no product is fused with a sum, and no quotient is approximate."""
    if target[0] == "hip" and version(triton) < (3, 6):
        pytest.skip("this Triton needs the linker of an installed ROCm")
    texts = []

    def compile_only(kernel, grid):
        return lambda *args, **options: texts.append(kernel.warmup(*args, grid=grid, **options).asm.get("ptx", ""))

    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(triton.JITFunction, "__getitem__", compile_only)
    driver = triton.runtime.driver
    before = vars(driver).copy()
    driver.set_active(Machine(*target))
    try:
        for name, *args in compile_calls():
            getattr(gpu, name)(*args)
    finally:
        vars(driver).clear()
        vars(driver).update(before)
    assert len(texts) > 100
    for text in texts:
        assert not re.search(r"\bfma\.rn\.f|\bdiv\.(full|approx)", text)


@computes
@pytest.mark.parametrize(("scale", "channels", "size"), [(4, 2, (12, 13)), (1, 3, (13, 12)), (3, 1, (12, 12))])
def test_the_site_wise_search_and_its_derivative(scale, channels, size):
    table = site_search.site_table("RGGB", 1, scale, (size[0] % 2 == 1, size[1] % 2 == 1), torch.device("cpu"))
    shares = torch.tensor([[1.0, 0.0], [0.25, 0.0], [0.0, 1.0]])
    flow = torch.randn(2, 2, 2, *size) * 3
    flow[0, 0, 0, 3, 4] = 2.0**30
    features = torch.randn(2, 3, channels, *size)
    expected = site_search._search_sites(features, flow, shares, *table.arguments)
    check(call("search_sites", features, flow, shares, *table.arguments), expected, rtol=0, atol=1e-5)
    grad = torch.randn_like(expected)
    expected = site_search._spread_sites(grad, flow, shares, *table.arguments)
    check(call("spread_sites", grad, flow, shares, *table.arguments), expected, rtol=0, atol=1e-4)


@computes
def test_a_level_of_tvl1():
    """The torch path in float32 is the reference; orders of sums differ."""
    clips, height, width = 2, 17, 20
    smooth = torch.nn.functional.avg_pool2d(torch.rand(clips, 3, height + 8, width + 8), 9, 1)
    pictures = torch.cat([smooth[:, :1], smooth[:, :1].roll((1, 1), (2, 3)) + 0.01 * smooth[:, 1:2]], dim=1)
    times, limit = torch.tensor([[-0.5, 0.5], [0.0, 1.0]]), 20 * smooth[:, 2]
    flow = torch.randn(clips, 2, height, width)
    constants = tvl1.ROUNDS, tvl1.SMOOTHINGS, tvl1.STEP, tvl1.STEP / tvl1.COUPLING
    expected = tvl1.refine(pictures, times, limit, flow, 2)
    check(call("tvl1_level", pictures, times, limit, flow, 2, *constants), expected, rtol=0, atol=1e-3)

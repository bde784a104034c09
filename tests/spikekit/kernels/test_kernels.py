"""The kernels of the sensor and the decoders, on CPU and GPU, against the torch paths.

CPU kernels use tiles of any size here. Without a GPU, GPU kernels run in Triton's interpreter, see test_kernels_gpu.py.
"""

import importlib.util
import os

import pytest
import torch

from spikekit.decoders import dense as decoders
from spikekit.kernels import compiler_kept_out, cpu
from spikekit.sensor import integrate_fire as sensor

OPERATORS = {
    "integrate_fire": sensor._integrate_fire,
    "spike_interval": decoders._spike_interval,
    "tfi": decoders._tfi,
    "tfp": decoders._tfp,
    "tfp_grad": decoders._tfp_grad,
}
FLOATS = [torch.float64, torch.float32, torch.bfloat16, torch.float16]
LIGHT = torch.rand(3, 4, 5)

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
GPU = ["gpu"] if importlib.util.find_spec("triton") and (INTERPRETED or torch.cuda.is_available()) else []
DEVICE = "cpu" if INTERPRETED else "cuda"


@pytest.fixture(params=[*([] if INTERPRETED else ["tiles of 7", "one tile"]), *GPU], name="run")
def _run(request, monkeypatch):
    """Run a kernel and return its results as a sequence on the CPU."""
    if request.param == "gpu":
        from spikekit.kernels import gpu as kernels
    else:
        kernels = cpu
        monkeypatch.setattr(cpu, "_TILE", 7 if request.param == "tiles of 7" else 1 << 16)

    def run(name, *args):
        where = DEVICE if kernels is not cpu else "cpu"
        results = getattr(kernels, name)(*[a.to(where) if isinstance(a, torch.Tensor) else a for a in args])
        return [result.cpu() for result in (results if isinstance(results, tuple) else (results,))]

    run.on_gpu, run.kernels = kernels is not cpu, kernels
    return run


def check(run, name, *args, rtol=0.0, atol=0.0):
    """Compare with the torch path, bit for bit by default; the interpreter truncates bfloat16 instead of rounding."""
    results, plain = run(name, *args), OPERATORS[name]._init_fn(*args)
    for got, expected in zip(results, plain if isinstance(plain, tuple) else (plain,), strict=True):
        least = 2**-7 if INTERPRETED and got.dtype is torch.bfloat16 else 0
        torch.testing.assert_close(got, expected, rtol=max(rtol, least), atol=atol, equal_nan=True)
    return results


of_the_cpu = pytest.mark.skipif(INTERPRETED, reason="the interpreter has nothing to do with it")


ARGUMENTS = {
    "integrate_fire": lambda x: (x, 0.6, x[..., 0, :, :].float(), torch.uint8),
    "spike_interval": lambda x: (x.round(),),
    "tfi": lambda x: (x.round(), 1.0, torch.float16),
    "tfp": lambda x: (x, 3, 1.0, torch.float64),
    "tfp_grad": lambda x: (x, 3, 1.0, torch.float64),
}


@of_the_cpu
@pytest.mark.parametrize("name", ARGUMENTS)
def test_registered_kernel_runs(name, monkeypatch, without_kernels):
    def stop(*_):
        raise InterruptedError

    monkeypatch.setattr(cpu, "_tiles", stop)
    with pytest.raises(InterruptedError):
        OPERATORS[name](*ARGUMENTS[name](LIGHT))
    with without_kernels(*OPERATORS.values()):
        OPERATORS[name](*ARGUMENTS[name](LIGHT))


@of_the_cpu
def test_operators_do_not_import_the_compiler():
    traced = []

    def inside(x):
        traced.append(torch.compiler.is_compiling())
        return x + 1

    for function in (inside, compiler_kept_out(inside)):
        torch.compiler.reset()
        compiled = torch.compile(lambda x, function=function: function(2 * x), backend="eager")
        assert [compiled(LIGHT).equal(2 * LIGHT + 1) for _ in range(2)] == [True, True]
    assert traced == [True, True, False, False]


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("dtype", FLOATS)
def test_sensor_equals_the_torch_path_for_any_light(run, dtype):
    """Three clocks of ordinary and extreme light in all combinations."""
    wide, inf = torch.promote_types(dtype, torch.float32), float("inf")
    theta = torch.tensor(0.3, dtype=wide)
    below, nan = theta.nextafter(theta * 0), float("nan")
    # of the last two float32's remainder is above theta, or below 0
    values = [0, -0.0, -0.5, 0.1, 0.3, below, 1e-12, 7.75, nan, inf, -inf, 5036367.5, 50865]
    values = torch.tensor(values, dtype=torch.float64)
    light = torch.cartesian_prod(values, values, values).to(dtype).T.reshape(3, 13, 169)
    for charge in (torch.zeros(13, 169), torch.rand(13, 169) * 0.29):
        for out in {dtype, torch.uint8}:
            check(run, "integrate_fire", light, 0.3, charge.to(wide), out)


def sizes(dtype):
    """Small sizes for the slow interpreter; 23 * 29 pixels exceed a block."""
    if INTERPRETED:
        return [(2, 5, 2, 3), (3, 23, 29)] if dtype is torch.float64 else [(2, 5, 2, 3)]
    return [(1, 1, 1), (40, 23, 29), (2, 3, 9, 2, 3)]


def draw(size, dtype):
    """Random pixels of every rate, including silent and always firing ones."""
    return (torch.rand(size) < 1.6 * torch.rand((*size[:-3], 1, *size[-2:])) - 0.3).to(dtype)


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int8, torch.int64, *FLOATS])
def test_decoders_equal_the_torch_path(run, dtype):
    for size in sizes(dtype):
        spikes = draw(size, dtype)
        check(run, "spike_interval", spikes)
        for out in (*FLOATS, torch.uint8) if dtype is torch.uint8 else (torch.float32,):
            check(run, "tfi", spikes, 255.0, out)
            for window in (3, 301):
                check(run, "tfp", spikes, window, 255.0, out)


@pytest.mark.parametrize("dtype", FLOATS)
def test_gradients_equal_the_torch_path(run, dtype):
    """With multiples of 1/8, whose sums are exact."""
    for size in sizes(dtype):
        grad = (torch.randint(-16, 17, size) / 8).to(dtype)
        for window in (3, 301):
            check(run, "tfp_grad", grad, window, 2.0, dtype, atol=64 * torch.finfo(dtype).eps)


def test_nonbinary_spikes_are_decoded_as_documented(run):
    """Any value but 0 is a spike for TFI; TFP sums the values."""
    for spikes in (torch.tensor([0.0, -0.0, 1e-45, float("nan"), -2.0, 0.0]), torch.tensor([0, 2**40, 0])):
        check(run, "spike_interval", spikes.reshape(-1, 1, 1))
    for spikes in (torch.randint(0, 256, (20, 2, 3), dtype=torch.uint8), torch.randint(-(2**20), 2**20, (20, 2, 3))):
        for window in (7, 259):
            check(run, "tfp", spikes, window, 1.0, torch.float64, rtol=1e-15)
    check(run, "tfp", torch.randn(30, 2, 3, dtype=torch.float64), 7, 2.0, torch.float64, atol=1e-13)


def test_long_streams_have_intervals_of_32_bits(run, monkeypatch):
    """From T = 32767 on intervals need 32 bits; the interpreter, at two milliseconds per frame, gets fewer frames."""
    for frames in (32766, 32767):
        dtype = torch.int16 if frames < 32767 else torch.int32
        assert run("spike_interval", torch.zeros(0, frames, 1, 1))[0].dtype is dtype
        if INTERPRETED:
            frames -= 32650
            monkeypatch.setattr(run.kernels, "_LONGEST", 116)
        spikes = torch.zeros(frames, 1, 4, dtype=torch.uint8)
        spikes[[5, frames - 3], :, 1] = 1
        spikes[0, :, 2] = spikes[-1, :, 3] = 1
        (interval,) = run("spike_interval", spikes)
        assert interval.dtype is dtype
        assert interval[100].flatten().tolist() == [frames + 1, frames - 8, frames, frames]


@pytest.mark.parametrize(("name", "args"), ARGUMENTS.items())
def test_any_memory_layout_gives_the_same_result(run, name, args):
    """Any layout of the input; GPU results keep it."""
    x = torch.rand(2, 9, 5, 4)
    for view in (x[:, :1].expand(2, 9, 5, 4), torch.rand(2, 9, 5, 8)[..., 1::2], x[0], x[:0]):
        check(run, name, *args(view), rtol=1e-6, atol=1e-6)
    for order in ([3, 2, 1, 0], [0, 1, 3, 2], [1, 2, 3, 0], [2, 3, 0, 1]):
        view = x.permute(order).contiguous().permute([order.index(i) for i in range(4)])
        result, *_ = check(run, name, *args(view), rtol=1e-6, atol=1e-6)
        assert not run.on_gpu or result.stride() == torch.empty_like(view).stride()

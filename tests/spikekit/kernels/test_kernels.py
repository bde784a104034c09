"""The kernels of the CPU against the torch paths of the same operators, at every size of tile."""

import pytest
import torch

import spikekit as sk
from spikekit.decoders import dense as decoders
from spikekit.kernels import compiler_kept_out, cpu
from spikekit.sensor import integrate_fire as sensor

OPERATORS = {
    "integrate_fire": sensor._integrate_fire,
    "integrate_fire_grad": sensor._integrate_fire_grad,
    "spike_interval": decoders._spike_interval,
    "tfi": decoders._tfi,
    "tfi_grad": decoders._tfi_grad,
    "tfp": decoders._tfp,
    "tfp_grad": decoders._tfp_grad,
}
FLOATS = [torch.float64, torch.float32, torch.bfloat16, torch.float16]
LIGHT = torch.rand(3, 4, 5)
SIZES = [(1, 1, 1), (40, 3, 5), (2, 3, 9, 2, 3)]


@pytest.fixture(params=[7, 1 << 16], autouse=True)
def tile(request, monkeypatch):
    monkeypatch.setattr(cpu, "_TILE", request.param)


def both(name, *args):
    """Results of the kernel and of the torch path."""
    fast, plain = OPERATORS[name](*args), OPERATORS[name]._init_fn(*args)
    return (fast, plain) if isinstance(fast, tuple) else ((fast,), (plain,))


def assert_equal(name, *args, atol=0.0):
    for fast, plain in zip(*both(name, *args), strict=True):
        assert fast.dtype == plain.dtype
        assert fast.shape == plain.shape
        torch.testing.assert_close(fast, plain, rtol=0, atol=atol, equal_nan=True)


def draw(size, dtype, density=0.3):
    return (torch.rand(size) < density).to(dtype)


@pytest.mark.parametrize(
    ("name", "args"),
    [
        ("integrate_fire", (LIGHT, 1.0, LIGHT[0], torch.uint8)),
        ("integrate_fire_grad", (LIGHT, LIGHT, 1.0)),
        ("spike_interval", (LIGHT,)),
        ("tfi", (LIGHT, 1.0, torch.float32)),
        ("tfi_grad", (LIGHT, LIGHT, LIGHT)),
        ("tfp", (LIGHT, 3, 1.0, torch.float32)),
        ("tfp_grad", (LIGHT, 3, 1.0, torch.float32)),
    ],
)
def test_the_kernel_is_what_runs(name, args, monkeypatch, without_kernels):
    def stop(*_):
        raise InterruptedError

    monkeypatch.setattr(cpu, "_tiles", stop)
    with pytest.raises(InterruptedError):
        OPERATORS[name](*args)
    with without_kernels(*OPERATORS.values()):
        OPERATORS[name](*args)


def test_the_compiler_is_kept_out():
    traced = []

    def inside(x):
        traced.append(torch.compiler.is_compiling())
        return x + 1

    for function in (inside, compiler_kept_out(inside)):
        torch.compiler.reset()
        compiled = torch.compile(lambda x, function=function: function(2 * x), backend="eager")
        assert [compiled(LIGHT).equal(2 * LIGHT + 1) for _ in range(2)] == [True, True]
    assert traced == [True, True, False, False]


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("most", [0.4, 5])
@pytest.mark.parametrize("threshold", [0.3, 1.0])
def test_integrate_fire(size, dtype, most, threshold):
    light = (torch.rand(size) * most).to(dtype)
    light.flatten()[:: 2 + light.numel() // 3] = threshold
    charge = torch.rand(*size[:-3], *size[-2:], dtype=torch.promote_types(dtype, torch.float32)) * threshold
    for out in (dtype, torch.uint8, torch.bool, torch.float16):
        assert_equal("integrate_fire", light, threshold, charge, out)
    assert_equal("integrate_fire", light, threshold, charge.double(), dtype)


@pytest.mark.parametrize("dtype", FLOATS)
def test_integrate_fire_of_strange_light(dtype):
    values = torch.tensor([0, -0.0, -0.5, -3, 0.25, 1, 2, 7.75, float("nan"), float("inf"), -float("inf"), 1e4])
    light = torch.stack(torch.meshgrid(values, values, values, indexing="ij")).to(dtype)
    light = light.movedim(1, 0).reshape(12, 3, 12, 12)
    charge = torch.zeros(12, 12, 12, dtype=torch.promote_types(dtype, torch.float32))
    assert_equal("integrate_fire", light, 1.0, charge, dtype)
    grad = torch.randn_like(light)
    grad[0] = float("inf")
    assert_equal("integrate_fire_grad", grad, light, 1.0)


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("threshold", [0.3, 1.0])
def test_integrate_fire_grad(size, dtype, threshold):
    light = ((torch.rand(size) * 3 - 1) * threshold).to(dtype)
    light.flatten()[::3] = threshold
    assert_equal("integrate_fire_grad", torch.randn(size).to(dtype), light, threshold)


@pytest.mark.parametrize("dtype", [*FLOATS, torch.bool, torch.uint8, torch.int64])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("density", [0.0, 0.3, 1.0])
def test_decoders(size, dtype, density):
    spikes = draw(size, dtype, density)
    assert_equal("spike_interval", spikes)
    for out in (torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.uint8):
        assert_equal("tfi", spikes, 255.0, out)
        for window in (1, 3, 9, 301):
            assert_equal("tfp", spikes, window, 255.0, out)


def test_decoders_count_what_is_no_bit():
    for spikes in (torch.randint(0, 256, (30, 2, 3), dtype=torch.uint8), torch.randint(-900, 900, (30, 2, 3))):
        for window in (1, 7, 259):
            assert_equal("tfp", spikes, window, 1.0, torch.float32)
    spikes = torch.randn(30, 2, 3, dtype=torch.float64)
    assert_equal("tfp", spikes, 7, 2.0, torch.float64, atol=1e-13)


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("density", [0.0, 0.2, 1.0])
def test_decoder_gradients(size, dtype, density):
    """On eighths, whose sums are exact."""
    grad = (torch.randint(-16, 17, size) / 8).to(dtype)
    spikes = draw(size, dtype, density)
    assert_equal("tfi_grad", grad, spikes, sk.tfi(spikes))
    for window in (1, 3, 9, 301):
        atol = 64 * torch.finfo(dtype).eps
        assert_equal("tfp_grad", grad, window, 2.0, dtype, atol=atol)


def test_long_streams():
    """From T = 32767 on, intervals need 32 bits."""
    for frames in (32766, 32767):
        spikes = torch.zeros(frames, 1, 4, dtype=torch.uint8)
        spikes[[5, frames - 3], :, 1] = 1
        spikes[0, :, 2] = spikes[-1, :, 3] = 1
        assert_equal("spike_interval", spikes)
        interval = sk.spike_interval(spikes)
        assert interval.dtype == (torch.int16 if frames < 32767 else torch.int32)
        assert interval[100].flatten().tolist() == [frames + 1, frames - 8, frames, frames]


def test_strides():
    light = torch.rand(6, 5, 4, 3).permute(3, 0, 2, 1)
    assert_equal("integrate_fire", light, 1.0, torch.zeros(4, 5).expand(3, 4, 5), torch.float32)
    spikes = (light > 0.4)[:, ::2]
    assert_equal("spike_interval", spikes)
    assert_equal("tfp", spikes[..., ::2], 3, 1.0, torch.float32)
    assert_equal("spike_interval", (torch.rand(1, 4, 5) < 0.5).expand(7, 4, 5))

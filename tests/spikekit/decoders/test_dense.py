"""The decoders against loops over every pixel; more cases are in the table of extremes."""

import brute_force
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from spikekit import Tfp, spike_interval, tfi, tfp

DTYPES = [torch.float64, torch.float32, torch.bfloat16, torch.float16]


def streams(frames, seed=0):
    """Pixels of every density: (frames, 5, 8)."""
    spikes = torch.rand(frames, 40, generator=torch.Generator().manual_seed(seed)) < torch.linspace(0, 1, 40)
    return spikes.reshape(frames, 5, 8)


@given(st.lists(st.booleans(), min_size=1, max_size=41), st.integers(0, 50))
def test_any_stream_is_decoded_as_by_brute_force(fired, half):
    spikes = torch.tensor(fired).reshape(-1, 1, 1)
    assert spike_interval(spikes).flatten().tolist() == brute_force.spike_interval(fired)
    assert tfi(spikes.double(), 3.0).flatten().tolist() == pytest.approx(list(map(float, brute_force.tfi(fired, 3.0))))
    rates = brute_force.tfp(fired, 3.0, 2 * half + 1)
    assert tfp(spikes, 2 * half + 1, 3.0).flatten().tolist() == pytest.approx(list(map(float, rates)))


@pytest.mark.parametrize(("order", "window"), [(2, 3), (3, 25), (5, 1)])
def test_tfp_of_higher_order_is_a_mean_of_means(order, window):
    spikes = streams(41)
    expected = spikes.double()
    for _ in range(order):
        expected = tfp(expected, window)
    for dtype in (torch.bool, *DTYPES):
        got = tfp(spikes.to(dtype), window, 255.0, order=order)
        assert got.dtype == (dtype if dtype.is_floating_point else torch.get_default_dtype())
        eps = max(torch.finfo(got.dtype).eps, torch.finfo(torch.float32).eps * order)
        torch.testing.assert_close(got.double(), 255 * expected, rtol=2 * eps, atol=255 * eps)
    byte = tfp(spikes, window, 255, order=order, dtype=torch.uint8)
    assert torch.equal(byte, tfp(spikes, window, 255.0, order=order).round().to(torch.uint8))
    assert torch.equal(Tfp(window, 255.0, order=order)(spikes), tfp(spikes, window, 255.0, order=order))
    leaf = torch.rand(7, 1, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s: tfp(s, window, 2.0, order=order), leaf)


def test_the_gradient_of_tfi_is_its_own_adjoint():
    spikes = streams(17).double().requires_grad_()
    weight, other = torch.randn(2, *spikes.shape, dtype=torch.float64)
    weight.requires_grad_()
    (grad,) = torch.autograd.grad((tfi(spikes) * weight).sum(), spikes, create_graph=True)
    (again,) = torch.autograd.grad((grad * other).sum(), weight)
    (expected,) = torch.autograd.grad((tfi(spikes) * other).sum(), spikes)
    assert torch.allclose(again, expected, rtol=1e-12, atol=1e-12)


def test_large_values_leave_no_error_in_the_running_sum_of_tfp():
    """A large value must not leave a rounding error behind."""
    spikes = torch.zeros(60, 1, 1)
    spikes[5], spikes[20:] = 1e8, 0.1
    assert torch.allclose(tfp(spikes, 5)[30:], torch.tensor(0.1), rtol=1e-6)


@pytest.mark.parametrize(
    "wrong", [*({"window": window} for window in (0, 2, 2.5)), {"order": 0}, {"max_range": 0}], ids=str
)
def test_wrong_options_are_rejected(wrong):
    (name,) = wrong
    calls = [lambda **options: tfp(torch.ones(3, 2, 2), **options), Tfp]
    for call in calls:
        with pytest.raises(ValueError, match=f"{name}: expected"):
            call(**{"window": 3} | wrong)
    with pytest.raises(TypeError, match="dtype"):
        tfp(torch.ones(3, 2, 2), 3, dtype=torch.int16)
    if name == "max_range":
        with pytest.raises(ValueError, match="max_range"):
            tfi(torch.ones(3, 2, 2), **wrong)


def test_compiled_tfp_takes_clips_of_any_length():
    torch.compiler.reset()
    compiled = torch.compile(lambda spikes: tfp(spikes, 11), fullgraph=True, backend="aot_eager", dynamic=True)
    shapes = ({0: torch.export.Dim("batch"), 1: torch.export.Dim("frames")},)
    exported = torch.export.export(Tfp(11), (torch.rand(2, 9, 4, 6),), dynamic_shapes=shapes, strict=False).module()
    for length in (9, 4, 30):
        spikes = torch.rand(3, length, 4, 6)
        torch.testing.assert_close(compiled(spikes), tfp(spikes, 11))
        torch.testing.assert_close(exported(spikes), tfp(spikes, 11))

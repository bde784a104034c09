"""The decoders against loops over every pixel, written from the contract."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.autograd import gradcheck, gradgradcheck

from spikekit import Tfp, spike_integrate_fire, spike_interval, tfi, tfp, tfp_at

DTYPES = [torch.float64, torch.float32, torch.bfloat16, torch.float16]


def enclosing(fired, n):
    """Last spike before n and first spike at or after n; None where there is none."""
    before = [k for k in range(n) if fired[k]]
    after = [k for k in range(n, len(fired)) if fired[k]]
    return before[-1] if before else None, after[0] if after else None


def interval_loop(fired):
    frames = len(fired)
    times = [k for k in range(frames) if fired[k]]
    complete = [b - a for a, b in pairwise(times)]
    result = []
    for n in range(frames):
        before, after = enclosing(fired, n)
        observed = (frames if after is None else after) - (-1 if before is None else before)
        if before is not None and after is not None:
            result.append(observed)
        elif complete and (before is None) != (after is None):
            result.append(max(observed, complete[0] if before is None else complete[-1]))
        else:
            result.append(observed)
    return result


def over_pixels(function, spikes):
    """Apply a function of one pixel's stream to every pixel of an array (*, T, H, W)."""
    return np.apply_along_axis(lambda stream: np.array(function(stream)), -3, spikes)


def streams(frames, seed=0):
    """One pixel of every density, and the ends: (frames, 5, 8)."""
    rng = np.random.default_rng(seed)
    density = np.concatenate([np.linspace(0, 1, 32), [0.02, 0.05, 0.1, 0.9]])
    spikes = (rng.random((frames, 36)) < density).astype(np.uint8)
    ends = np.zeros((frames, 4), dtype=np.uint8)
    ends[0, 0] = ends[-1, 1] = ends[frames // 2, 2] = ends[0, 3] = ends[-1, 3] = 1
    return np.concatenate([spikes, ends], axis=1).reshape(frames, 5, 8)


CLIPS = pytest.mark.parametrize("frames", [1, 2, 3, 17, 41])


@CLIPS
def test_interval_loop(frames):
    spikes = np.stack([streams(frames, seed) for seed in range(3)])
    expected = over_pixels(interval_loop, spikes)
    interval = spike_interval(torch.from_numpy(spikes))
    assert interval.dtype == torch.int16
    assert np.array_equal(interval.numpy(), expected)
    assert torch.equal(spike_interval(torch.from_numpy(spikes)[None, 1])[0], interval[1])
    for dtype in (torch.bool, torch.int64, torch.float64, torch.float32, torch.float16, torch.bfloat16):
        got = spike_interval(torch.from_numpy(spikes).to(dtype))
        assert got.dtype == (dtype if dtype.is_floating_point else torch.int16)
        assert np.array_equal(got.double().numpy(), expected)


@pytest.mark.parametrize(
    ("fired", "expected"),
    [
        ("0000", [5, 5, 5, 5]),
        ("1111", [1, 1, 1, 1]),
        ("1000", [1, 4, 4, 4]),
        ("0001", [4, 4, 4, 4]),
        ("0100", [2, 2, 3, 3]),
        ("01100000", [2, 2, 1, 6, 6, 6, 6, 6]),  # waited longer than the last interval
        ("0100010", [4, 4, 4, 4, 4, 4, 4]),  # the nearest interval is longer than what was waited
        ("1100010", [1, 1, 4, 4, 4, 4, 4]),
    ],
)
def test_interval_by_hand(fired, expected):
    spikes = torch.tensor([int(c) for c in fired]).reshape(-1, 1, 1)
    assert spike_interval(spikes).flatten().tolist() == expected
    assert interval_loop(spikes.flatten().tolist()) == expected


@given(st.lists(st.booleans(), min_size=1, max_size=41))
def test_interval_laws(fired):
    spikes = torch.tensor(fired).reshape(-1, 1, 1)
    interval = spike_interval(spikes).flatten().tolist()
    assert interval == interval_loop(fired)
    assert min(interval) >= 1
    assert max(interval) <= len(fired) + 1
    assert tfp(spikes, 2 * len(fired) + 1)[0].item() == pytest.approx(sum(fired) / len(fired))


@pytest.mark.parametrize("period", [1, 2, 5, 7])
@pytest.mark.parametrize("phase", [0, 4])
def test_regular_train(period, phase):
    """Constant light decodes to its rate everywhere, ends included, as soon as one interval is complete."""
    spikes = (torch.arange(41) % period == phase % period).reshape(-1, 1, 1)
    assert (spike_interval(spikes) == period).all()
    assert torch.allclose(tfi(spikes.double(), 3.0), torch.tensor(3.0 / period, dtype=torch.float64), rtol=1e-15)


@pytest.mark.parametrize(("frames", "dtype"), [(32766, torch.int16), (32767, torch.int32)])
def test_interval_of_long_clips(frames, dtype):
    interval = spike_interval(torch.zeros(frames, 1, 1, dtype=torch.bool))
    assert interval.dtype == dtype
    assert (interval == frames + 1).all()


@CLIPS
@pytest.mark.parametrize("max_range", [1.0, 255.0])
def test_tfi(frames, max_range):
    spikes = torch.from_numpy(streams(frames))
    expected = max_range / over_pixels(interval_loop, spikes.numpy())
    assert np.allclose(tfi(spikes.double(), max_range).numpy(), expected, rtol=1e-15, atol=0)
    for dtype in (torch.bool, torch.uint8, torch.float32, torch.float16, torch.bfloat16):
        got = tfi(spikes.to(dtype), max_range)
        assert got.dtype == (dtype if dtype.is_floating_point else torch.get_default_dtype())
        divided = np.float32(max_range) / spike_interval(spikes).numpy().astype(np.float32)
        assert torch.equal(got, torch.from_numpy(divided).to(got.dtype))


@CLIPS
@pytest.mark.parametrize("max_range", [1.0, 4.0])
def test_tfi_gradient(frames, max_range):
    array = streams(frames)
    weight = np.random.default_rng(1).integers(-8, 9, array.shape).astype(float)
    expected = np.zeros(array.shape)
    for y, x in np.ndindex(*array.shape[1:]):
        fired = array[:, y, x]
        interval = interval_loop(fired)
        for n in range(frames):
            before, after = enclosing(fired, n)
            begin = 0 if before is None else before + 1
            end = frames if after is None else after + 1
            expected[begin:end, y, x] += weight[n, y, x] * max_range / interval[n]
    spikes = torch.from_numpy(array).double().requires_grad_()
    (grad,) = torch.autograd.grad((tfi(spikes, max_range) * torch.from_numpy(weight)).sum(), spikes)
    assert np.allclose(grad.numpy(), expected, rtol=1e-12, atol=1e-12)
    for dtype in (torch.float32, torch.float16, torch.bfloat16):
        spikes = torch.from_numpy(array).to(dtype).requires_grad_()
        (grad,) = torch.autograd.grad((tfi(spikes, max_range) * torch.from_numpy(weight).to(dtype)).sum(), spikes)
        assert grad.dtype == dtype
        eps = torch.finfo(dtype).eps
        assert np.allclose(grad.double().numpy(), expected, rtol=2 * eps, atol=64 * eps)


def tfp_loop(stream, window, max_range):
    half, frames = (window - 1) // 2, len(stream)
    inside = [[stream[k] for k in range(frames) if abs(k - n) <= half] for n in range(frames)]
    return [max_range * sum(map(float, values)) / len(values) for values in inside]


@CLIPS
@pytest.mark.parametrize("window", [1, 11, 99])
@pytest.mark.parametrize("max_range", [1.0, 255.0])
def test_tfp(frames, window, max_range):
    spikes = np.stack([streams(frames), streams(frames, 1)])
    expected = over_pixels(lambda stream: tfp_loop(stream, window, max_range), spikes)
    for dtype in (torch.bool, torch.uint8, torch.int32, *DTYPES):
        got = tfp(torch.from_numpy(spikes).to(dtype), window, max_range)
        assert got.dtype == (dtype if dtype.is_floating_point else torch.get_default_dtype())
        assert np.allclose(got.double().numpy(), expected, rtol=torch.finfo(got.dtype).eps * 2, atol=0)
    assert torch.equal(tfp(torch.from_numpy(spikes[1]), window), tfp(torch.from_numpy(spikes), window)[1])


@pytest.mark.parametrize(("order", "window"), [(2, 3), (3, 13), (3, 25), (5, 1)])
def test_tfp_of_higher_order_is_a_mean_of_means(order, window):
    spikes = streams(41)
    expected = spikes
    for _ in range(order - 1):
        expected = over_pixels(lambda stream: tfp_loop(stream, window, 1.0), expected)
    expected = over_pixels(lambda stream: tfp_loop(stream, window, 255.0), expected)
    for dtype in (torch.bool, *DTYPES):
        got = tfp(torch.from_numpy(spikes).to(dtype), window, 255.0, order=order)
        assert got.dtype == (dtype if dtype.is_floating_point else torch.get_default_dtype())
        eps = max(torch.finfo(got.dtype).eps, torch.finfo(torch.float32).eps * order)
        np.testing.assert_allclose(got.double().numpy(), expected, rtol=2 * eps, atol=255 * eps)
    light = torch.from_numpy(spikes)
    byte = tfp(light, window, 255, order=order, dtype=torch.uint8)
    assert torch.equal(byte, tfp(light, window, 255.0, order=order).round().to(torch.uint8))
    assert torch.equal(Tfp(window, 255.0, order=order)(light), tfp(light, window, 255.0, order=order))


def test_tfp_of_third_order_cancels_what_pixels_round_away():
    """Constant light, any initial charge: a third of the noise of the mean over as many frames."""
    light = torch.linspace(0.1, 0.9, 97, dtype=torch.float64)
    charge = torch.linspace(0, 1, 33, dtype=torch.float64)[:-1, None].expand(-1, 97)
    spikes, _ = spike_integrate_fire(light.expand(41, 32, -1), charge=charge)
    noise = [(tfp(spikes, window, order=order)[20] - light).square().mean() for window, order in ((37, 1), (13, 3))]
    assert noise[1] < 0.1 * noise[0]


@pytest.mark.parametrize("order", [0, -1, 1.5, True])
def test_tfp_refuses_an_order(order):
    for make in (lambda: tfp(torch.zeros(3, 1, 1), 3, order=order), lambda: Tfp(3, order=order)):
        with pytest.raises(ValueError, match="order: expected a whole number >= 1"):
            make()


def test_tfp_counts_uint8_past_255():
    for dtype in (torch.uint8, torch.bool):
        assert torch.allclose(tfp(torch.ones(600, 1, 1, dtype=dtype), 601), torch.ones(1))
    assert (tfp(torch.ones(5000, 1, 1, dtype=torch.float16), 3) == 1).all()


@pytest.mark.parametrize("op", [tfi, lambda s, m, dtype: tfp(s, 5, m, dtype=dtype)])
def test_dtype_of_the_result(op):
    spikes = torch.from_numpy(streams(41))
    exact = op(spikes.double(), 255.0, dtype=None)
    for came in (torch.bool, torch.uint8, torch.float32):
        for dtype in DTYPES:
            got = op(spikes.to(came), 255.0, dtype=dtype)
            assert got.dtype == dtype
            torch.testing.assert_close(got.double(), exact, rtol=max(torch.finfo(dtype).eps, 1e-7), atol=0)
        picture = op(spikes.to(came).requires_grad_(came.is_floating_point), 255.0, dtype=torch.uint8)
        assert not picture.requires_grad
        assert torch.equal(picture, exact.float().round().to(torch.uint8))  # to the nearest, not down
    assert op(spikes, 1000.0, dtype=torch.uint8).max() == 255
    for dtype in (torch.int16, torch.bool, "uint8"):
        with pytest.raises(TypeError, match="dtype"):
            op(spikes, 1.0, dtype=dtype)


def test_second_gradients():
    """TFP is linear; the gradient of TFI is linear in the one that comes, and its own adjoint."""
    spikes = torch.from_numpy(streams(17)).double().requires_grad_()
    assert gradgradcheck(lambda s: tfp(s, 5, 2.0), torch.rand(6, 1, 2, dtype=torch.float64, requires_grad=True))
    weight, other = torch.randn(2, *spikes.shape, dtype=torch.float64)
    weight.requires_grad_()
    (grad,) = torch.autograd.grad((tfi(spikes) * weight).sum(), spikes, create_graph=True)
    (again,) = torch.autograd.grad((grad * other).sum(), weight)
    (expected,) = torch.autograd.grad((tfi(spikes) * other).sum(), spikes)
    assert torch.allclose(again, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("op", [tfi, lambda clip: tfp(clip, 5)], ids=["tfi", "tfp"])
def test_gradients_of_many_clips_at_once(op):
    """vmap over the gradients of one clip, first and second, and over many vectors for one gradient."""
    clips = torch.from_numpy(np.stack([streams(17), streams(17)[::-1]])).double()

    def first(clip):
        return torch.func.grad(lambda given: op(given).pow(3).sum())(clip)

    second = torch.func.grad(lambda clip: first(clip).square().sum())
    for gradient in (first, second):
        assert torch.func.vmap(gradient)(clips).equal(torch.stack([gradient(clip) for clip in clips]))
    vectors = torch.randn(3, *clips[0].shape, dtype=torch.float64)
    pull = torch.func.vjp(op, clips[0])[1]
    assert torch.func.vmap(pull)(vectors)[0].equal(torch.stack([pull(one)[0] for one in vectors]))


def test_tfp_forgets_what_has_left_the_window():
    """A large number must not leave its rounding error behind."""
    spikes = torch.zeros(60, 1, 1)
    spikes[5], spikes[20:] = 1e8, 0.1
    assert torch.allclose(tfp(spikes, 5)[30:], torch.tensor(0.1), rtol=1e-6)


@pytest.mark.parametrize(("frames", "window"), [(7, 5), (3, 9)])
def test_tfp_gradcheck(frames, window):
    spikes = torch.rand(frames, 1, 2, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda s: tfp(s, window, 2.0), spikes)
    assert gradcheck(lambda s: tfp(s, window, 2.0, order=3), spikes)


@pytest.mark.parametrize("op", [spike_interval, tfi, lambda s: tfp(s, 3)])
@pytest.mark.parametrize(
    ("error", "spikes"),
    [
        (TypeError, [[[1]]]),
        (TypeError, torch.ones(3, 2, 2, dtype=torch.complex64)),
        (ValueError, torch.ones(2, 2)),
        (ValueError, torch.ones(0, 2, 2)),
        (ValueError, torch.ones(3, 0, 2)),
    ],
)
def test_wrong_spikes(op, error, spikes):
    with pytest.raises(error):
        op(spikes)


@pytest.mark.parametrize("window", [0, 2, -1, 2.5, True])
def test_wrong_window(window):
    with pytest.raises(ValueError, match="window"):
        tfp(torch.ones(3, 2, 2), window)


@pytest.mark.parametrize("max_range", [0, -1.0, float("inf"), float("nan")])
def test_wrong_range(max_range):
    for op in (tfi, lambda s, max_range: tfp(s, 3, max_range)):
        with pytest.raises(ValueError, match="max_range"):
            op(torch.ones(3, 2, 2), max_range)


@pytest.mark.parametrize("window", [17, 2**70 + 1])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.bool, torch.int64, torch.float32])
def test_windows_beyond_the_clip(window, dtype):
    """The mean of all frames, however long the window."""
    spikes = ((torch.rand(2, 9, 4, 6) < 0.4) * (1 if dtype is torch.bool else 255)).to(dtype)
    expected = spikes.double().mean(-3, keepdim=True).expand(2, 9, 4, 6).float()
    for order in (1, 2):
        torch.testing.assert_close(tfp(spikes, window, order=order), expected)
        torch.testing.assert_close(tfp_at(spikes, 3, window, order=order), expected[:, 3])
    leaf = spikes.double().requires_grad_()
    (grad,) = torch.autograd.grad(tfp(leaf, window).sum(), leaf)
    torch.testing.assert_close(grad, torch.ones_like(leaf))


@pytest.mark.parametrize("window", [3, 11])
def test_a_window_in_a_clip_of_any_length(window):
    torch.compiler.reset()
    compiled = torch.compile(lambda spikes: tfp(spikes, window), fullgraph=True, backend="aot_eager", dynamic=True)
    batch, frames = torch.export.Dim("batch"), torch.export.Dim("frames")
    clip = torch.rand(2, 9, 4, 6)
    shapes = ({0: batch, 1: frames},)
    exported = torch.export.export(Tfp(window), (clip,), dynamic_shapes=shapes, strict=False).module()
    for length in (9, 4, 30):
        spikes = torch.rand(3, length, 4, 6)
        torch.testing.assert_close(compiled(spikes), tfp(spikes, window))
        torch.testing.assert_close(exported(spikes), tfp(spikes, window))


@pytest.mark.parametrize("dtype", [torch.uint16, torch.uint32, torch.uint64])
def test_wide_unsigned_spikes(dtype):
    spikes = torch.rand(9, 4, 6) < 0.4
    for op in (tfi, spike_interval, lambda s: tfp(s, 3), lambda s: tfp(s, 41, 255.0, dtype=torch.uint8)):
        assert torch.equal(op(spikes.to(dtype)), op(spikes))

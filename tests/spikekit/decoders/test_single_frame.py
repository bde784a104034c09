"""A key frame equals that frame of the dense decoder, and only the necessary frames are read."""

import brute_force
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from spikekit import spike_interval, spike_interval_at, tfi, tfi_at, tfp, tfp_at
from spikekit.decoders.single_frame import _spike_interval_at, search, tfp_weights


@given(st.integers(1, 40), st.floats(0, 1), st.integers(0, 2**31), st.data())
def test_results_equal_those_of_one_pixel_at_a_time(frames, rate, seed, data):
    spikes = torch.rand(frames, 3, 4, generator=torch.Generator().manual_seed(seed)) < rate
    frame = data.draw(st.integers(0, frames - 1))
    pixels = spikes.flatten(1).T.tolist()
    expected = [brute_force.spike_interval(pixel)[frame] for pixel in pixels]
    assert spike_interval_at(spikes, frame).flatten().tolist() == expected
    assert _spike_interval_at(spikes, frame).flatten().tolist() == expected  # what runs on other devices


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int32, torch.float16, torch.bfloat16, torch.float64])
def test_equals_the_frame_of_the_dense_decoder(dtype):
    spikes = (torch.rand(2, 3, 30, 4, 5) < torch.rand(4, 5) * 0.3).to(dtype)
    for frame in (0, 14, 29):
        for got, whole in [
            (spike_interval_at(spikes, frame), spike_interval(spikes)),
            (tfi_at(spikes, frame), tfi(spikes)),
            (tfi_at(spikes, frame, 255.0, dtype=torch.uint8), tfi(spikes, 255.0, dtype=torch.uint8)),
            (tfi_at(spikes, frame, 0.3, dtype=torch.float16), tfi(spikes, 0.3, dtype=torch.float16)),
        ]:
            assert got.dtype is whole.dtype
            assert got.equal(whole[..., frame, :, :])


@pytest.mark.parametrize("frames", [255, 256, 40_000])
def test_long_intervals_do_not_overflow(frames):
    """One-byte counters must not overflow."""
    spikes = torch.zeros(frames, 1, 3, dtype=torch.uint8)
    spikes[3, 0, 0] = spikes[-1, 0, 0] = 1
    spikes[[0, frames // 2], 0, 1] = 1
    whole = spike_interval(spikes)
    for frame in (0, 4, frames // 2 + 1, frames - 1):
        assert spike_interval_at(spikes, frame).equal(whole[frame])


def test_reads_only_the_frames_it_needs():
    """Frames are read outwards until every pixel has fired on both sides."""
    spikes = np.zeros((100, 2, 2), np.uint8)
    spikes[[40, 44, 50, 53], :, :] = 1
    seen = []
    assert (search(lambda n: seen.append(n) or spikes[n], 48, range(100)) == 6).all()
    assert set(seen) == set(range(44, 51))
    seen.clear()
    spikes[:48] = 0
    assert (search(lambda n: seen.append(n) or spikes[n], 48, range(30, 100)) == 21).all()
    assert set(seen) == set(range(30, 54))


def test_strides_batches_and_gradients():
    spikes = (torch.rand(5, 4, 30) < 0.2).float().requires_grad_().permute(2, 0, 1)
    rate = tfi_at(spikes, 7)
    assert rate.equal(tfi(spikes)[7])
    assert not rate.requires_grad
    assert tfi_at(spikes.detach()[:, None].expand(30, 2, 5, 4).movedim(0, 1), 7).equal(rate.expand(2, 5, 4))
    assert tfi_at(torch.zeros(0, 3, 4, 5), 1).shape == (0, 4, 5)


@pytest.mark.parametrize("window", [1, 11, 61])
@pytest.mark.parametrize("order", [1, 2, 3])
def test_mean_equals_the_frame_of_the_dense_decoder(window, order):
    spikes = torch.rand(2, 3, 30, 4, 5, generator=torch.Generator().manual_seed(0)) < 0.3
    for dtype in (torch.bool, torch.uint8, torch.float16, torch.bfloat16, torch.float64):
        for frame in (0, 14, 29):
            got = tfp_at(spikes.to(dtype), frame, window, 0.3, order=order)
            whole = tfp(spikes.to(dtype), window, 0.3, order=order)[..., frame, :, :]
            torch.testing.assert_close(got, whole, rtol=max(1e-6, torch.finfo(whole.dtype).eps), atol=1e-7)
    picture = tfp_at(spikes, 14, window, 255.0, order=order, dtype=torch.uint8).int()
    assert (picture - tfp(spikes, window, 255.0, order=order, dtype=torch.uint8)[..., 14, :, :].int()).abs().max() <= 1


def test_mean_is_linear_with_its_weights_as_gradient():
    light = torch.rand(9, 2, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda values: tfp_at(values, 2, 5, 1.5, order=2), light)
    (gradient,) = torch.autograd.grad(tfp_at(light, 2, 5, order=2).sum(), light)
    first, weights = tfp_weights(9, 2, 5, 2)
    assert first == 0
    assert gradient[:7, 0, 0].tolist() == pytest.approx(weights)
    assert not gradient[7:].any()
    assert sum(weights) == pytest.approx(1)


def test_mean_of_a_pixel_that_always_fires_is_exact_at_the_extremes():
    """A mean over a whole recording, half precision, and a range near the largest value of the dtype."""
    spikes = torch.ones(70_001, 1, 2, dtype=torch.uint8)
    assert tfp_at(spikes, 35_000, 2001, order=2).sub(1).abs().max() <= 2e-6
    assert tfp_at(spikes[:2001].half(), 1000, 2001).tolist() == [[1, 1]]
    assert tfp_at(spikes[:41], 20, 41, 6e4, dtype=torch.float16).tolist() == [[60000, 60000]]
    assert not tfp_at(torch.zeros(41, 1, 2), 20, 13, order=3).any()


@pytest.mark.parametrize("op", [spike_interval_at, tfi_at, lambda spikes, frame: tfp_at(spikes, frame, 3)])
def test_compiled_and_mapped_results_are_equal(op, capfd):
    spikes = torch.rand(3, 9, 4, 6) < 0.3
    torch.compiler.reset()
    assert torch.compile(op, fullgraph=True, backend="aot_eager")(spikes, 4).equal(op(spikes, 4))
    for axis in (0, 1, 3):
        assert torch.func.vmap(lambda one: op(one, 4), axis)(spikes.movedim(0, axis)).equal(op(spikes, 4))
    assert capfd.readouterr().err == ""  # without a rule of its own vmap loops, and says so
    for frame, error in ((9, ValueError), (-1, ValueError), (2.0, TypeError)):
        with pytest.raises(error, match="frame: expected"):
            op(spikes, frame)


@pytest.mark.parametrize(
    ("call", "error", "name"),
    [
        (lambda spikes: tfi_at(spikes, 0, 0.0), ValueError, "max_range"),
        (lambda spikes: tfi_at(spikes, 0, dtype=torch.int32), TypeError, "dtype"),
        (lambda spikes: tfp_at(spikes, 1, 4), ValueError, "window"),
        (lambda spikes: tfp_at(spikes, 1, 3, 0.0), ValueError, "max_range"),
        (lambda spikes: tfp_at(spikes, 1, 3, order=0), ValueError, "order"),
    ],
)
def test_bad_options_are_rejected(call, error, name):
    with pytest.raises(error, match=name):
        call(torch.ones(5, 4, 4))

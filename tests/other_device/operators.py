"""Every operator on the device of pretend.py; run by test_other_device.py in a process of its own."""

import pretend
import pytest
import torch
from test_api import EVERY, FLOW, RGB, SPIKES, module_of, outputs

import spikekit as sk

DEVICE = pretend.DEVICE
LIBRARY = pretend.register()


def there(*tensors):
    return [tensor.detach().to(DEVICE) for tensor in tensors]


def test_the_device_does_not_mix():
    with pytest.raises(RuntimeError, match="some tensors are on the device"):
        RGB.to(DEVICE) + RGB
    pretend.waits.clear()
    assert torch.equal((RGB.to(DEVICE) + torch.tensor(1.0)).cpu(), RGB + 1)
    assert pretend.waits == ["aten::_to_copy"]


@EVERY
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])  # of half precision, all are computed in float32
def test_operators_give_the_results_of_the_cpu(op, options, tensors, dtype):
    moved = [tensor.requires_grad_() for tensor in there(*(tensor.to(dtype) for tensor in tensors))]
    kept = [tensor.detach().to(dtype).requires_grad_() for tensor in tensors]
    for got, expected in zip(outputs(op(*moved, **options)), outputs(op(*kept, **options)), strict=True):
        assert got.device == DEVICE
        torch.testing.assert_close(got.detach().cpu(), expected.detach())
        if expected.requires_grad:
            expected.square().sum().backward(retain_graph=True)
            got.square().sum().backward(retain_graph=True)
    for one, other in zip(moved, kept, strict=True):
        assert (one.grad is None) == (other.grad is None)
        if other.grad is not None:
            torch.testing.assert_close(one.grad.cpu(), other.grad)
    module_of(op, options).to(DEVICE)(*(tensor.detach() for tensor in moved))


@pytest.mark.parametrize(
    ("call", "tensors"),
    [
        (lambda spikes: sk.tfi_at(spikes, 4), [SPIKES]),
        (lambda spikes: sk.tfp_at(spikes, 4, 5, order=2), [SPIKES]),
        (lambda spikes: sk.tfp(spikes, 5, order=3), [SPIKES]),
        (lambda spikes: sk.spike_interval_at(spikes.bool(), 4), [SPIKES]),
        (lambda spikes: sk.unpack_spikes(sk.pack_spikes(spikes), 6), [SPIKES]),
        (lambda spikes: torch.cat(list(sk.decode_in_chunks(sk.tfi, spikes.split(3), 9))), [SPIKES[0]]),
        (lambda rgb: sk.psnr(rgb, 0.5 * rgb), [RGB]),
        (lambda rgb: sk.ssim(rgb, 0.5 * rgb), [torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(0))]),
        (sk.flow_to_rgb, [FLOW]),
        (lambda light, charge: sk.simulate_spikes(light, charge=charge), [0.3 * SPIKES, 0.5 * RGB[:, 0]]),
        (lambda light: sk.SpikeSensor(sk.SensorNoise(photons=100, dark_current=0.1), seed=1).expose(light), [SPIKES]),
        (
            lambda picture, mask: sk.Scene(
                [
                    sk.Layer(picture, sk.Motion(velocity=(0.25, 0.5))),
                    sk.Layer(picture[:, :8, :8], sk.Motion(velocity=(1.0, 0.0)), position=(4, 4), mask=mask),
                ],
                *(8, 12),
                frames=3,
            ).light("RGGB", scale=4, alpha=0.4),
            [torch.rand(3, 20, 20, generator=torch.Generator().manual_seed(0)), torch.ones(8, 8)],
        ),
    ],
)
def test_results_are_on_the_device_of_the_tensors(call, tensors):
    got = call(*there(*tensors))
    assert got.device == DEVICE
    torch.testing.assert_close(got.cpu(), call(*tensors))


def test_new_tensors_are_on_the_given_device():
    assert torch.equal(sk.bayer_mask(4, 6, scale=3, device=DEVICE).cpu(), sk.bayer_mask(4, 6, scale=3))
    assert sk.simulate_spikes(torch.rand(5, 4, 6, device=DEVICE)).device == DEVICE

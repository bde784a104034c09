"""Joint flow, upsampling and linear motion."""

import numpy as np
import pytest
import torch

from spikekit import LinearMotion, joint_flow, linear_motion, upsample_flow

LEADS = pytest.mark.parametrize("lead", [(), (3, 2)])


@LEADS
def test_joint_flow_is_the_mean(lead):
    flows = torch.randint(-32, 33, (4, *lead, 2, 3, 5)).double()
    expected = (flows[0] + flows[1] + flows[2] + flows[3]) / 4
    assert torch.equal(joint_flow(flows), expected)
    assert torch.equal(joint_flow(list(flows)), expected)
    assert torch.equal(joint_flow(tuple(flows[:1])), flows[0])


def upsample_loop(flow, scale):
    """Bilinear with aligned pixel areas: fine centre X lies at (X + 1/2) / s - 1/2; borders are replicated."""
    height, width = flow.shape[-2:]
    fine = np.zeros((*flow.shape[:-2], scale * height, scale * width))
    for y, x in np.ndindex(*fine.shape[-2:]):
        py = min(max((y + 0.5) / scale - 0.5, 0), height - 1)
        px = min(max((x + 0.5) / scale - 0.5, 0), width - 1)
        for j in range(height):
            for i in range(width):
                fine[..., y, x] += max(0, 1 - abs(py - j)) * max(0, 1 - abs(px - i)) * flow[..., j, i]
    return fine * scale


@LEADS
@pytest.mark.parametrize("scale", [1, 3, 4])
@pytest.mark.parametrize("size", [(1, 1), (3, 4)])
def test_upsample_flow_equals_a_loop(lead, scale, size):
    flow = torch.randn(*lead, 2, *size, dtype=torch.float64)
    assert np.allclose(upsample_flow(flow, scale).numpy(), upsample_loop(flow.numpy(), scale), atol=1e-12)


@LEADS
@pytest.mark.parametrize("scale", [1, 3])
def test_linear_motion_is_linear_on_either_side_of_the_middle(lead, scale):
    to_first, to_last = torch.randn(2, *lead, 2, 3, 4, dtype=torch.float64)
    times, (i, j, k) = [0.0, 5, 19.5, 20, 20.5, 38, 40, 44], (1, 20, 39)
    offsets = linear_motion(to_first, to_last, times, first=i, middle=j, last=k, scale=scale)
    assert offsets.shape == (*lead, len(times), 2, 3 * scale, 4 * scale)
    first, last = (upsample_loop(flow.numpy(), scale) for flow in (to_first, to_last))
    for n, t in enumerate(times):
        expected = (t - j) / (i - j) * first if t < j else (t - j) / (k - j) * last
        assert np.allclose(offsets[..., n, :, :, :].numpy(), expected, atol=1e-12)
        if t == j:
            assert (offsets[..., n, :, :, :] == 0).all()


def test_first_and_last_time_are_the_defaults():
    to_first, to_last = torch.randn(2, 1, 2, 2, 2)
    times = range(5, 36, 3)
    offsets = linear_motion(to_first, to_last, times)
    assert torch.equal(offsets, linear_motion(to_first, to_last, times, first=5, middle=20, last=35))
    assert torch.equal(offsets[:, 0], to_first)
    assert torch.equal(offsets[:, -1], to_last)
    assert (offsets[:, 5] == 0).all()


FLOW = torch.zeros(1, 2, 3, 3)


@pytest.mark.parametrize(
    ("error", "call"),
    [
        (ValueError, lambda: joint_flow([])),
        (ValueError, lambda: joint_flow([FLOW, torch.zeros(1, 2, 3, 4)])),
        (ValueError, lambda: joint_flow(torch.zeros(4, 3, 3, 3))),
        (TypeError, lambda: joint_flow([1.0])),
        (ValueError, lambda: upsample_flow(FLOW, 0)),
        (ValueError, lambda: linear_motion(FLOW, FLOW, [0, 4], middle=4)),
        (ValueError, lambda: linear_motion(FLOW, FLOW[:, :, 1:], [0, 4])),
        (TypeError, lambda: linear_motion(FLOW, None, [0, 4])),
    ],
)
def test_invalid_arguments_are_rejected(error, call):
    with pytest.raises(error):
        call()


@pytest.mark.parametrize(
    ("times", "error", "message"),
    [
        (None, TypeError, "times: expected numbers, got None"),
        (5, TypeError, "times: expected numbers, got 5"),
        (["soon"], TypeError, "times: expected numbers"),
        ([], ValueError, "times: expected at least one time, got none"),
        ([2, 1, 0], ValueError, r"first, middle, last: expected increasing times, got 2.0, 1.0, 0.0"),
    ],
)
def test_invalid_times_are_rejected(times, error, message):
    """By the function, and by the module at its construction."""
    for call in (lambda: linear_motion(FLOW, FLOW, times), lambda: LinearMotion(times)):
        with pytest.raises(error, match=message):
            call()

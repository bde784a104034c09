"""Every row of the table of extremes, and that the table notices an operator that is wrong."""

import math
from fractions import Fraction

import brute_force
import numpy as np
import pytest
import torch

import spikekit as sk
from extremes import CASES, autograd
from extremes.table import Cases, Measured, differ, rounded_once, short, state, ulps

ROWS = [
    pytest.param(
        case,
        dtype,
        id=f"{case.operator}-{case.extreme}-{short(dtype)}",
        marks=[pytest.mark.slow] if case.slow else [],
    )
    for case in sorted(
        CASES, key=lambda case: list(dict.fromkeys(each.operator for each in CASES)).index(case.operator)
    )
    for dtype in case.dtypes
]


@pytest.mark.parametrize(("case", "dtype"), ROWS)
def test_error_stays_within_the_bound_of_its_row(case, dtype, device, note):
    row = case.row(dtype, device)
    note(row)
    assert row.passed, row


def find(operator, extreme):
    return next(case for case in CASES if (case.operator, case.extreme) == (operator, extreme))


def fires_above(light, threshold=1.0, charge=None, **options):
    """A sensor that waits for more than the threshold."""
    return FIRE(light, math.nextafter(threshold, math.inf) * (1 + 1e-6), charge, **options)


def looks_at_the_next(spikes, *args, **options):
    """The interval off by one frame."""
    return TFI(spikes.roll(-1, dims=-3), *args, **options)


def half_coordinates(features, flow, mask, **options):
    """Positions in the dtype of the flow."""
    column = torch.arange(flow.shape[-1], dtype=flow.dtype, device=flow.device)
    x = (column + flow[..., :1, :, :]).float() - torch.arange(flow.shape[-1], device=flow.device)
    return IDW(features, torch.cat([x, flow[..., 1:, :, :].float()], dim=-3), mask, **options)


def lets_through(features, flow, mask, **options):
    """Reads unknown pixels, with weight 0."""
    return IDW(features, flow, mask, **options) + 0 * features


FIRE, TFI, IDW = sk.spike_integrate_fire, sk.tfi, sk.flow_warp_idw


@pytest.mark.parametrize(
    ("broken", "operator", "extreme", "dtype"),
    [
        (fires_above, "spike_integrate_fire", "light at the threshold", torch.float32),
        (looks_at_the_next, "tfi", "one spike, at the first clock", torch.uint8),
        (looks_at_the_next, "tfi", "gradient by the stated contract", torch.float32),
        (half_coordinates, "flow_warp_idw", "columns 2040 to 4104", torch.float16),
        (lets_through, "flow_warp_idw", "NaN at unknown pixels is not read", torch.float32),
        (lets_through, "flow_warp_idw", "no known pixel", torch.float32),
    ],
)
def test_a_wrong_operator_fails(broken, operator, extreme, dtype, monkeypatch):
    case = find(operator, extreme)
    assert case.row(dtype).passed
    if extreme == "no known pixel":
        monkeypatch.setattr(sk, operator, lambda features, *_: features)
    else:
        monkeypatch.setattr(sk, operator, broken)
    assert not case.row(dtype).passed


def test_an_outcome_that_is_not_the_documented_one_fails():
    cases = Cases()
    for values, gradients in (("finite", "finite"), ("NaN", "finite"), ("finite", "Inf")):
        cases.add("op", "x", values="finite")(lambda *_, v=values, g=gradients: Measured(0.0, v, g))
    cases.add("op", "y")(lambda *_: Measured(float("nan"), "finite", "finite"))
    assert [case.row(torch.float32).passed for case in cases] == [True, False, False, False]


def test_references_give_values_found_by_hand():
    assert brute_force.integrate_fire([0.5, 0.75, -0.5, 3.25], 1.0) == ([False, True, False, True], 0)
    assert brute_force.straight_through(1.0, 1.0) == 1
    assert brute_force.straight_through(float("nan"), 1.0) == 0
    assert brute_force.spike_interval([0, 1, 0, 0, 1, 0, 0, 0, 0]) == [3, 3, 3, 3, 3, 5, 5, 5, 5]
    assert brute_force.tfp([1, 0, 0, 1], 3.0, 3) == [Fraction(3, 2), 1, 1, Fraction(3, 2)]
    features, mask = np.array([[[1.0, 9.0, 4.0]]]), np.array([[1, 0, 1]])
    flow = np.zeros((2, 1, 3))
    flow[0, 0] = [0.5, 0.0, -0.5]
    values, slope, _ = brute_force.idw(features, flow, mask, neighbors=4)
    assert values.tolist() == [[[1.75, 2.5, 3.25]]]  # distances 0.5 and 1.5: weights 3/4 and 1/4
    # (1 / 0.5 * 1 + 1 / 1.5 * 4) / (1 / 0.5 + 1 / 1.5) is 1 + 3 x / 2 between the two
    assert np.allclose(slope[0, 0, 0], 1.5)
    assert np.allclose(slope[0, 1], 0)
    assert brute_force.bilinear(features, flow).tolist() == [[[5.0, 9.0, 6.5]]]


def test_errors_are_measured_in_units_in_the_last_place():
    one = torch.tensor([1.0, 2.0], dtype=torch.float16)
    assert ulps(one, torch.tensor([1.0 + 2**-10, 2.0], dtype=torch.float64)) == 1
    assert ulps(one * float("nan"), one.double()) != 0
    assert ulps(one / 0, one.double() / 0) == 0
    assert math.isinf(ulps(one, one.double()[None]))
    assert differ(one, one.double()) == 0
    assert math.isinf(autograd._compare([one], [one, one]))  # a gradient that got lost
    assert differ(torch.tensor([1.0, float("nan")]), torch.tensor([2.0, float("nan")])) == 1
    assert [state(one), state(one, one / 0), state(one / 0, one * float("nan"))] == ["finite", "Inf", "NaN"]
    assert rounded_once(8)(torch.float32) == 8
    assert 0.5 < rounded_once(8)(torch.bfloat16) < 0.5002

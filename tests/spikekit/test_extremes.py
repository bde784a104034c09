"""Every row of the table of extremes, that no row gets lost, and that the table notices an operator that is wrong."""

import argparse
import math
import sys
from fractions import Fraction

import numpy as np
import pytest
import torch

import spikekit as sk
from spikekit import extremes
from spikekit.examples import EXAMPLES
from spikekit.extremes import autograd, reference, sizes
from spikekit.extremes.table import BITS, FLOATS, Cases, Measured, On, differ, rounded_once, short, state, ulps

ROWS = [
    pytest.param(
        case,
        dtype,
        device,
        id=f"{case.operator}-{case.extreme}-{short(dtype)}-{device}",
        marks=[pytest.mark.slow] if case.slow else [],
    )
    for device in extremes.devices()
    for case in extremes.CASES
    for dtype in case.dtypes
]


@pytest.mark.parametrize(("case", "dtype", "device"), ROWS)
def test_row(case, dtype, device):
    row = case.row(dtype, device)
    assert row.passed, row


ANY = {*FLOATS, *BITS}
FLOAT32, FLOAT64 = {torch.float32}, {torch.float64}
SENSOR = """
    light 0 everywhere; light at the threshold; light one ulp below the threshold; light 1e-12 of the threshold;
    light 1e6 thresholds; a step from dark to saturated in one clip;
    light below 0: a debt; light NaN: silent from then on; light +Inf: fires, and is empty;
    light -Inf: silent from then on; threshold 1e6; gradient at the ends of [0, threshold]; chunks equal the whole
"""
DECODER = """
    no spike; a spike at every clock; one spike, at the first clock; one spike, at the last clock;
    clips of 1 frame, all; clips of 2 frames, all; clips of 3 frames, all; bool, uint8 and float streams agree;
    chunks that overlap equal the whole
"""
RATE = "pictures in uint8, max_range 1, 255, 1000"
WINDOW = """
    window of the clip; window longer than the clip; window of 10^12 + 1 frames; window even; window 0;
    300 spikes in one window
"""
IDW = """
    zero flow: known pixels stay; flow of any length; flow of whole pixels: hits and ties; flow of half pixels: ties;
    1e-30 away from a known pixel; flow of 1e4 pixels; flow NaN: the pixel stays; flow Inf: very far;
    flow Inf or NaN: no gradient by it; 1 known pixel: that one everywhere; 2 known pixels; 3 known pixels;
    no known pixel; NaN at unknown pixels is not read; 1 x 1; 1 x W; H x 1; odd size; columns 2040 to 4104;
    gradient on a known pixel is 0; gradient by the flow: anywhere; gradient by the flow: at ties;
    gradient by the flow: 1e-2 to 1e-15 from a known pixel; steps=16, worst error; steps=16, root of the mean square
"""
BILINEAR = """
    zero flow; flow of any length; flow of whole and half pixels; 1e-30 away from a pixel; flow of 1e4 pixels;
    flow NaN: the pixel stays; flow Inf: the border; 1 x 1, 1 x W, H x 1, odd size; columns 2040 to 4104
"""
SHAPES = "batch of 0; leading dimensions (2, 1, 3); non-contiguous; expanded; channels last"
TRANSFORMS = "torch.export, batch of any size; torch.autocast; torch.func.vmap; deterministic mode"
EVERY = [example.name for example in EXAMPLES]
SMOOTH = [name for name in EVERY if name not in ("spike_integrate_fire", "spike_interval", "tfi")]


def split(names):
    return [" ".join(name.split()) for name in names.split(";")]


REQUIRED = [
    *[("spike_integrate_fire", extreme, set(FLOATS)) for extreme in split(SENSOR)],
    ("spike_integrate_fire", "constant light over 1,000,000 clocks", FLOAT32 | FLOAT64),
    ("spike_integrate_fire", "threshold 1e-6", set(FLOATS[:3])),
    ("spike_integrate_fire", "threshold 1e-6 (1e6 is no float16)", set(FLOATS[3:])),
    ("spike_integrate_fire", "1000 x 1000 x 400 stream", FLOAT32),
    *[(decoder, extreme, ANY) for decoder in ("spike_interval", "tfi", "tfp") for extreme in split(DECODER)],
    *[(decoder, "1000 x 1000 x 400 stream", {torch.uint8}) for decoder in ("spike_interval", "tfi", "tfp")],
    *[(decoder, RATE, ANY) for decoder in ("tfi", "tfp")],
    *[(decoder, "gradient by the stated contract", set(FLOATS)) for decoder in ("tfi", "tfp")],
    *[("tfp", extreme, ANY) for extreme in split(WINDOW)],
    *[("flow_warp_idw", extreme, set(FLOATS)) for extreme in split(IDW)],
    *[("flow_warp", extreme, set(FLOATS)) for extreme in split(BILINEAR)],
    *[(operator, extreme, FLOAT32) for operator in EVERY for extreme in split(f"{SHAPES}; {TRANSFORMS}")],
    *[(operator, "torch.func.grad", FLOAT32) for operator in EVERY if operator != "spike_interval"],
    *[(operator, "torch.compile, fullgraph", FLOAT64) for operator in EVERY],
    *[(operator, check, FLOAT64) for operator in SMOOTH for check in ("gradcheck", "gradgradcheck")],
]


def test_no_row_is_lost():
    there = {(case.operator, case.extreme): set(case.dtypes) for case in extremes.CASES}
    assert len(there) == len(extremes.CASES)
    if not sizes.Path("/proc/self/status").exists():
        there |= {(operator, extreme): dtypes for operator, extreme, dtypes in REQUIRED if "stream" in extreme}
    assert [row for row in REQUIRED if there.get(row[:2]) != row[2]] == []


def find(operator, extreme):
    return next(case for case in extremes.CASES if (case.operator, case.extreme) == (operator, extreme))


def fires_above(light, threshold=1.0, charge=None, **options):
    """A sensor that waits for more than the threshold."""
    return FIRE(light, math.nextafter(threshold, math.inf) * (1 + 1e-6), charge, **options)


def drops_debt(light, threshold=1.0, charge=None, **options):
    return FIRE(light.clamp(min=0), threshold, charge, **options)


def looks_at_the_next(spikes, *args, **options):
    """The interval off by one frame."""
    return TFI(spikes.roll(-1, dims=-3), *args, **options)


def rounds_down(spikes, *args, **options):
    result = TFI(spikes, *args, **options)
    return result if not result.is_floating_point() else result * (1 - torch.finfo(result.dtype).eps)


def ignores_the_ends(spikes, window, *args, **options):
    return TFP(spikes, window, *args, **options) * (min(window, spikes.shape[-3]) / window)


def half_coordinates(features, flow, mask, **options):
    """Positions in the dtype of the flow."""
    column = torch.arange(flow.shape[-1], dtype=flow.dtype, device=flow.device)
    x = (column + flow[..., :1, :, :]).float() - torch.arange(flow.shape[-1], device=flow.device)
    return IDW(features, torch.cat([x, flow[..., 1:, :, :].float()], dim=-3), mask, **options)


def lets_through(features, flow, mask, **options):
    """Reads unknown pixels, with weight 0."""
    return IDW(features, flow, mask, **options) + 0 * features


def one_graph_a_size(light, *args, **options):
    return FIRE(light * (1 if light.shape[-1] > 15 else 1.0), *args, **options)


class TwiceInBatches(torch.autograd.Function):
    """Has another gradient by vmap."""

    generate_vmap_rule = True

    @staticmethod
    def forward(features):
        return features.clone()

    @staticmethod
    def setup_context(ctx, inputs, output):
        pass

    @staticmethod
    def backward(ctx, gradient):
        return gradient * (2 if torch._C._functorch.is_batchedtensor(gradient) else 1)


def learns_twice_by_vmap(features, flow):
    return WARP(TwiceInBatches.apply(features), flow)


FIRE, TFI, TFP, IDW, WARP = sk.spike_integrate_fire, sk.tfi, sk.tfp, sk.flow_warp_idw, sk.flow_warp


@pytest.mark.parametrize(
    ("broken", "operator", "extreme", "dtype"),
    [
        (fires_above, "spike_integrate_fire", "light at the threshold", torch.float32),
        (drops_debt, "spike_integrate_fire", "light below 0: a debt", torch.float32),
        pytest.param(
            one_graph_a_size, "spike_integrate_fire", "torch.compile, fullgraph", torch.float64, marks=pytest.mark.slow
        ),
        (looks_at_the_next, "tfi", "one spike, at the first clock", torch.uint8),
        (looks_at_the_next, "tfi", "gradient by the stated contract", torch.float32),
        (rounds_down, "tfi", "a spike at every clock", torch.float16),
        (ignores_the_ends, "tfp", "clips of 3 frames, all", torch.bool),
        (half_coordinates, "flow_warp_idw", "columns 2040 to 4104", torch.float16),
        (lets_through, "flow_warp_idw", "NaN at unknown pixels is not read", torch.float32),
        (lets_through, "flow_warp_idw", "no known pixel", torch.float32),
        (learns_twice_by_vmap, "flow_warp", "torch.func.vmap", torch.float32),
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


@pytest.mark.parametrize(("operator", "extreme"), [("tfi", "no spike"), ("flow_warp_idw", "flow of any length")])
def test_an_error_is_a_row_that_fails(operator, extreme, monkeypatch):
    def raises(*_, **__):
        raise RuntimeError("out of order")

    monkeypatch.setattr(sk, operator, raises)
    row = find(operator, extreme).row(torch.float32)
    assert not row.passed
    assert row.trouble == "RuntimeError: out of order"


def test_an_outcome_that_is_not_the_documented_one_fails():
    cases = Cases()
    for values, gradients in (("finite", "finite"), ("NaN", "finite"), ("finite", "Inf")):
        cases.add("op", "x", values="finite")(lambda *_, v=values, g=gradients: Measured(0.0, v, g))
    cases.add("op", "y")(lambda *_: Measured(float("nan"), "finite", "finite"))
    assert [case.row(torch.float32).passed for case in cases] == [True, False, False, False]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read from /proc")
def test_memory_is_measured():
    shorter = sizes._BITS.replace("400", "100")
    four_bytes = sizes._memory("stream.float().to(torch.uint8)", shorter, On(torch.uint8, torch.device("cpu")))
    assert 3.8 < four_bytes.error < 4.5


def parse(*argv):
    parser = argparse.ArgumentParser()
    extremes.add_arguments(parser)
    return parser.parse_args(argv)


@pytest.fixture
def few(monkeypatch):
    kept = [case for case in extremes.CASES if case.extreme in ("no spike", "flow of any length", "window even")]
    monkeypatch.setattr(extremes, "CASES", kept)


def test_run(few, capsys, tmp_path):
    extremes.run(parse("--operator", "tfp", "--device", "cpu"))
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    assert lines[1] == "tfp on cpu"
    assert lines[2].split()[:7] == ["extreme", "float64", "float32", "bfloat16", "float16", "bool", "uint8"]
    assert [line.split("  ")[0] for line in lines[3:]] == ["no spike", "window even"]
    assert lines[4].split()[-3:] == ["-", "an", "error"]
    assert "12 rows, none fails" in printed.err

    extremes.run(parse("--markdown", "--device", "cpu", "-o", str(tmp_path / "table.md")))
    table = (tmp_path / "table.md").read_text().splitlines()
    assert capsys.readouterr().out == ""
    assert [line for line in table if line.startswith("#")] == [
        f"## {name} on cpu" for name in ("spike_interval", "tfi", "tfp", "flow_warp_idw", "flow_warp")
    ]
    assert all(line.startswith(("|", "#")) for line in table if line)
    assert len({line.count("|") for line in table[table.index("## tfi on cpu") + 2 :][:3]}) == 1


def test_run_fails_where_a_row_does(few, capsys, monkeypatch):
    monkeypatch.setattr(sk, "tfi", looks_at_the_next)
    monkeypatch.setattr(sk, "flow_warp_idw", lambda features, *_, **__: features * float("nan"))
    extremes.run(parse("--operator", "tfi", "--device", "cpu"))  # no spike: nothing to be late
    with pytest.raises(ValueError, match="4 of 4 rows fail"):
        extremes.run(parse("--operator", "flow_warp_idw", "--device", "cpu"))
    printed = capsys.readouterr()
    assert printed.out.count("FAILS") == 4
    assert "flow_warp_idw, flow of any length, float32 on cpu" in printed.err


def test_reference_by_hand():
    assert reference.integrate_fire([0.5, 0.75, -0.5, 3.25], 1.0) == ([False, True, False, True], 0)
    assert reference.straight_through(1.0, 1.0) == 1
    assert reference.straight_through(float("nan"), 1.0) == 0
    assert reference.spike_interval([0, 1, 0, 0, 1, 0, 0, 0, 0]) == [3, 3, 3, 3, 3, 5, 5, 5, 5]
    assert reference.tfp([1, 0, 0, 1], 3.0, 3) == [Fraction(3, 2), 1, 1, Fraction(3, 2)]
    features, mask = np.array([[[1.0, 9.0, 4.0]]]), np.array([[1, 0, 1]])
    flow = np.zeros((2, 1, 3))
    flow[0, 0] = [0.5, 0.0, -0.5]
    values, slope, _ = reference.idw(features, flow, mask, neighbors=4)
    assert values.tolist() == [[[1.75, 2.5, 3.25]]]  # distances 0.5 and 1.5: weights 3/4 and 1/4
    # (1 / 0.5 * 1 + 1 / 1.5 * 4) / (1 / 0.5 + 1 / 1.5) is 1 + 3 x / 2 between the two
    assert np.allclose(slope[0, 0, 0], 1.5)
    assert np.allclose(slope[0, 1], 0)
    assert reference.bilinear(features, flow).tolist() == [[[5.0, 9.0, 6.5]]]


def test_yardsticks():
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

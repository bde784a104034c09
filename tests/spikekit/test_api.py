"""Properties of every operator: module, dtypes, unmodified inputs, meta tensors, wrong types.

Strides, sizes, autocast, vmap, compilation and export are tested by the table of extremes.
"""

import inspect
import re
import shutil

import pytest
import torch
from operator_examples import EXAMPLES
from torch import nn

import spikekit as sk

SPIKES = (torch.rand(2, 9, 4, 6, generator=torch.Generator().manual_seed(1)) < 0.4).double()
RGB = torch.rand(2, 3, 4, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
FLOW = 4 * torch.rand(2, 2, 4, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(3)) - 2
MASK = sk.bayer_mask(4, 6, dtype=torch.float64)[1]
INDEX, WEIGHT = torch.arange(192).reshape(2, 4, 24) % 24, RGB.repeat(1, 2, 1, 1)[:, :4].flatten(2)

# function, arguments of the module, tensors it is called with
OPERATORS = [
    (getattr(sk, example.name), example.options, (*tensors, *example.constants(tensors[0])))
    for example in EXAMPLES
    for tensors in [example.tensors((2,))]
]
EVERY = pytest.mark.parametrize(("op", "options", "tensors"), OPERATORS, ids=[op.__name__ for op, *_ in OPERATORS])


DTYPES = [torch.float64, torch.float32, torch.bfloat16, torch.float16]


def camel(name):
    return re.sub(r"(?:^|_)([a-z])", lambda letter: letter[1].upper(), name)


def module_of(op, options):
    return getattr(sk, camel(op.__name__))(**options)


def outputs(result):
    return result if isinstance(result, tuple) else (result,)


def assert_same(got, expected):
    for one, other in zip(outputs(got), outputs(expected), strict=True):
        assert one.dtype == other.dtype
        assert torch.equal(one, other)


def test_every_module_has_its_function():
    modules = [
        name for name in sk.__all__ if inspect.isclass(getattr(sk, name)) and issubclass(getattr(sk, name), nn.Module)
    ]
    covered = {camel(op.__name__) for op, *_ in OPERATORS} | {"BayerMask"}
    assert set(modules) == covered
    assert all(getattr(sk, name).__doc__ for name in sk.__all__ if not name.isupper())


@EVERY
def test_module_equals_function(op, options, tensors):
    module = module_of(op, options)
    assert_same(module(*tensors), op(*tensors, **options))
    assert not list(module.state_dict())
    for name, value in options.items():
        if name not in ("first", "middle", "last"):
            assert f"{name}={value!r}" in repr(module)


def test_sensor_module_takes_a_charge():
    light, charge = SPIKES * 0.3125, RGB[:, 0] / 2
    module = sk.SpikeIntegrateFire(0.75)
    expected = sk.spike_integrate_fire(light, 0.75, charge)
    assert_same(module(light, charge), expected)
    torch.compiler.reset()
    assert_same(torch.compile(module, fullgraph=True, backend="aot_eager")(light, charge), expected)
    assert_same(torch.export.export(module, (light, charge), strict=False).module()(light, charge), expected)


@EVERY
@pytest.mark.parametrize("dtype", DTYPES)
def test_dtype_and_device_are_kept(op, options, tensors, dtype, device):
    narrow = [tensor.to(device, dtype) for tensor in tensors]
    result = outputs(op(*narrow, **options))
    assert result[0].dtype == dtype
    assert result[0].device.type == device.type
    # the right answer for the numbers that came in, rounded once or so
    expected = outputs(op(*[tensor.double() for tensor in narrow], **options))[0]
    eps = max(torch.finfo(dtype).eps, 1e-6)
    if "demosaic_" in op.__name__:  # the guided filter divides by variances, which are small on noise
        eps = max(eps, 1e-4)
    torch.testing.assert_close(result[0].double(), expected, rtol=2 * eps, atol=4 * eps)


@EVERY
def test_inputs_are_not_modified(op, options, tensors):
    kept = [tensor.clone() for tensor in tensors]
    for result in outputs(op(*tensors, **options)):
        if result.data_ptr() not in [tensor.data_ptr() for tensor in tensors]:
            result.zero_()
    for tensor, before in zip(tensors, kept, strict=True):
        assert torch.equal(tensor, before)


@EVERY
def test_meta_tensors_give_the_shapes_of_the_results(op, options, tensors):
    results = outputs(op(*[tensor.to("meta") for tensor in tensors[:2]], *tensors[2:], **options))
    assert [result.shape for result in results] == [result.shape for result in outputs(op(*tensors, **options))]


@EVERY
def test_wrong_types_are_rejected(op, options, tensors):
    first, *others = tensors
    for wrong, error, said in (
        (first.numpy(), TypeError, r"torch\.from_numpy"),  # the remedy
        (first.flatten(), ValueError, "expected"),
        (first[..., :0], ValueError, "expected"),
        (first.to(torch.complex64), TypeError, "expected"),
    ):
        if op is sk.joint_flow and error is TypeError:
            continue  # it takes any sequence of flows
        with pytest.raises(error, match=said):
            op(wrong, *others, **options)


@pytest.mark.parametrize("dynamic", [None, True])
def test_scales_of_motion_may_vary_in_compiled_code(dynamic):
    def motion(flow, scale):
        return sk.upsample_flow(flow, scale), sk.linear_motion(flow, -flow, [0, 1, 4], scale=scale)

    torch.compiler.reset()
    compiled = torch.compile(motion, fullgraph=True, backend="aot_eager", dynamic=dynamic)
    for scale in (2, 3, 4):
        torch.testing.assert_close(compiled(FLOW, scale), motion(FLOW, scale))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="Inductor needs a compiler of C++")
def test_inductor_compiles_the_pipeline_from_light_to_a_warped_picture():
    def picture(light, flow):
        spikes, _ = sk.spike_integrate_fire(light)
        return sk.flow_warp(sk.tfp(spikes, 5)[:, 4:5], flow)

    def run(function):
        leaves = (0.8 * SPIKES).requires_grad_(), FLOW.clone().requires_grad_()
        result = function(*leaves)
        return [result, *torch.autograd.grad(result.square().sum(), leaves)]

    torch.compiler.reset()
    few = {"compile_threads": 1, "cpp.vec_isa_ok": False}  # runs of the compiler of C++, which take half a minute
    for got, expected in zip(run(torch.compile(picture, fullgraph=True, options=few)), run(picture), strict=True):
        torch.testing.assert_close(got, expected)


@pytest.mark.parametrize(
    ("op", "arguments"),
    [
        (torch.ops.spikekit.integrate_fire, ((SPIKES * 0.7).requires_grad_(), 1.0, RGB[:, 0], torch.float64)),
        (torch.ops.spikekit.tfi, (SPIKES.clone().requires_grad_(), 1.0, torch.float64)),
        (torch.ops.spikekit.tfi_grad, (SPIKES, SPIKES, SPIKES)),
        (torch.ops.spikekit.tfp, (SPIKES.clone().requires_grad_(), 3, 1.0, torch.float64)),
        (torch.ops.spikekit.tfp_grad, (SPIKES.clone().requires_grad_(), 3, 1.0, torch.float64)),
        (torch.ops.spikekit.spike_interval, (SPIKES > 0,)),
        (torch.ops.spikekit.spike_interval_at, (SPIKES > 0, 4)),
        (torch.ops.spikekit.spike_interval_at, (torch.zeros(33_000, 1, 2) > 0, 4)),  # longer than 16 bits count
        (torch.ops.spikekit.pack_bits, (SPIKES.byte(),)),
        (torch.ops.spikekit.unpack_bits, (SPIKES.byte(), 13)),
        (torch.ops.spikekit.nearest_known, (FLOW, MASK, 4)),
        (torch.ops.spikekit.weighted_gather, (RGB.flatten(2), INDEX, WEIGHT)),
        (torch.ops.spikekit.weighted_scatter, (RGB.flatten(2), INDEX, WEIGHT, 24)),
        (torch.ops.spikekit.weighted_dot, (RGB.flatten(2), RGB.flatten(2), INDEX)),
    ],
    ids=lambda value: str(value).rpartition(".")[2] if "spikekit" in str(value) else "",
)
def test_custom_operators_are_registered_correctly(op, arguments):
    torch.library.opcheck(
        op.default, arguments, test_utils=("test_schema", "test_autograd_registration", "test_faketensor")
    )

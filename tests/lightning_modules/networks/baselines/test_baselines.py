"""Common properties of the baselines: sizes, gradients, skip, phases, published sizes, invalid arguments."""

import pytest
import torch
import torch.nn.functional as F

from lightning_modules import networks
from lightning_modules.motion import ZeroFlow
from spikekit import demosaic_along_motion, demosaic_residual, linear_motion, tfi, tfp

STAR = {"per_channel": True}
CASES = [
    ("BasicVSR", {"width": 4, "blocks": 1}),
    ("RealRawVSR", {"width": 8, "blocks": 2}),
    ("SpikeSRNetLike", {"width": 8, "maps": 3, "corrections": 2}),
    ("SpikeSRNetLike", {"width": 8, "maps": 3, "corrections": 2, **STAR}),
    ("SwinIR", {"width": 12, "groups": 2, "layers": 2, "heads": 2}),
    ("TSCNN", {"width": 32, "blocks": 1, "low": 1, "high": 1}),
    ("VidarSR", {"width": 6, "features": 3}),
    ("VidarSR", {"width": 6, "features": 3, **STAR}),
]
EVERY = pytest.mark.parametrize(("name", "tiny"), CASES)


def clip(batch=1, height=12, width=16):
    generator = torch.Generator().manual_seed(0)
    spikes = (torch.rand(batch, 41, height, width, generator=generator) < 0.3).to(torch.uint8)
    return spikes, torch.randn(batch, 2, 2, height, width, generator=generator)


def build(name, seed=0, **settings):
    """A network with random weights instead of those initialised with zeros, and without stochastic depth."""
    torch.manual_seed(seed)
    network = getattr(networks, name)(**{"scale": 2, **settings})
    for module in network.modules():
        if hasattr(module, "where"):
            torch.nn.init.normal_(module.where.weight, std=0.1)
        if hasattr(module, "gamma"):
            torch.nn.init.ones_(module.gamma)
        if hasattr(module, "drop"):
            module.drop = 0.0
    return network


@EVERY
@pytest.mark.parametrize(("scale", "size"), [(2, (3, 3)), (3, (9, 7)), (4, (4, 6))])
def test_any_size_and_scale(name, tiny, scale, size):
    spikes, flow = clip(2, *size)
    rgb = build(name, scale=scale, **tiny)(spikes, flow)
    assert rgb.shape == (2, 3, scale * size[0], scale * size[1])
    assert rgb.isfinite().all()


@EVERY
def test_every_parameter_has_a_gradient(name, tiny):
    resting = None
    for seed in range(4):  # all of a few channels may be inactive by chance
        network = build(name, seed, **tiny)
        network(*clip(2, 9, 8)).square().mean().backward()
        silent = {name for name, one in network.named_parameters() if one.grad is None or not one.grad.any()}
        resting = silent if resting is None else resting & silent
        if not resting:
            break
    assert not resting


@EVERY
def test_takes_flow_states_whether_the_flow_matters(name, tiny):
    network, (spikes, flow) = build(name, **tiny).eval(), clip()
    with torch.no_grad():
        still, moved = network(spikes, static=True), network(spikes, flow)
        assert network.takes_flow == (not moved.equal(still))
        assert network(spikes, 0 * flow).equal(still)
    assert network.halo is None
    if network.takes_flow:
        with torch.no_grad():
            assert build(name, **tiny, motion=ZeroFlow()).eval()(spikes).equal(still)


@EVERY
def test_bfloat16_keeps_the_picture_in_float32(name, tiny):
    network, (spikes, flow) = build(name, **tiny).eval(), clip()
    with torch.no_grad():
        exact = network(spikes, flow)
        with torch.autocast("cpu", torch.bfloat16):
            half = network(spikes, flow)
    assert half.dtype == torch.float32
    assert 0 < (half - exact).abs().max() < 0.1 * exact.abs().max()


# as published; BasicVSR without the 1,440,300 of SPyNet, VidarSR with 9,216 more for three planes per picture
@pytest.mark.parametrize(
    ("name", "settings", "counts"),
    [
        ("BasicVSR", {"blocks": 30}, {4: 6_291_311 - 1_440_300}),
        ("BasicVSR", {"blocks": 15}, {4: 4_075_631 - 1_440_300}),
        ("RealRawVSR", {}, {2: 4_476_509, 3: 4_678_459, 4: 4_773_853}),
        ("SpikeSRNetLike", {}, {2: 2_278_443, 3: 2_889_067, 4: 3_343_659}),
        ("SwinIR", {}, {2: 910_152, 3: 918_267, 4: 929_628}),
        ("TSCNN", {}, {2: 1_424_903, 3: 1_433_558, 4: 1_445_675}),
        ("TSCNN", {"blocks": 4, "low": 4, "high": 6}, {4: 3_409_075}),
        ("VidarSR", {"width": 256, "features": 64}, {2: 10_161_896, 3: 11_386_600, 4: 12_799_720}),
        ("VidarSR", {"width": 256, "features": 64, **STAR}, {2: 12_785_894}),
    ],
)
def test_number_of_parameters_as_published(name, settings, counts):
    for scale, expected in counts.items():
        with torch.device("meta"):
            network = getattr(networks, name)(scale=scale, **settings)
        assert sum(p.numel() for p in network.parameters()) == expected


@pytest.mark.parametrize(
    ("name", "settings", "decode"),
    [
        ("VidarSR", {"width": 4, "features": 2}, tfi),
        ("SpikeSRNetLike", {"width": 8, "maps": 2, "corrections": 1}, tfi),
        ("RealRawVSR", {"width": 8, "blocks": 2}, tfi),
        ("RealRawVSR", {"width": 8, "blocks": 2, "decoder": "tfp"}, lambda spikes: tfp(spikes, 41)),
        ("TSCNN", {"width": 8, "blocks": 1, "low": 1, "high": 1}, tfi),
        ("TSCNN", {"width": 8, "blocks": 1, "low": 1, "high": 1, "decoder": "tfp"}, lambda spikes: tfp(spikes, 41)),
        ("SwinIR", {"width": 12, "groups": 1, "layers": 2, "heads": 2}, None),
    ],
)
def test_skip_starts_from_the_decoded_picture(name, settings, decode):
    network, (spikes, flow) = build(name, **settings, alpha=0.5, pattern="GBRG", skip=True), clip(2)
    rgb = network(spikes, flow)
    if decode:
        picture = demosaic_residual(2 * decode(spikes)[:, 20], "GBRG")
    else:
        times = [10, 15, 20, 25, 30]
        offsets = linear_motion(flow[:, 0], flow[:, 1], times, first=5, middle=20, last=35)
        picture = demosaic_along_motion(2 * tfi(spikes)[:, times], offsets, "GBRG")
    torch.testing.assert_close(rgb, F.interpolate(picture, scale_factor=2, mode="bicubic"), rtol=0, atol=1e-4)
    (rgb - 1).square().mean().backward()  # and training goes on from there
    assert sum(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters()) >= 2


@pytest.mark.parametrize("case", [3, 6])  # networks that split the colours themselves
def test_mosaic_shifted_by_a_pixel_has_another_phase(case):
    name, tiny = CASES[case]
    tiny = {**tiny, **({"corrections": 1} if "corrections" in tiny else {})}
    network, moved, other = (build(name, **tiny, pattern=one).double() for one in ("RGGB", "GRBG", "RGGB"))
    spikes, flow = clip(1, 40, 48)
    inner = (..., slice(32, -32), slice(32, -32))
    expected = network(spikes, flow.double())[inner]
    rolled = spikes.roll(1, dims=-1), flow.double().roll(1, dims=-1)
    deviation = [(net(*rolled).roll(-2, dims=-1)[inner] - expected).abs().max() for net in (moved, other)]
    assert deviation[0] < 1e-3 * deviation[1]


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("BasicVSR", {"frames": 11}, "frames: expected at least 13, got 11"),
        ("RealRawVSR", {"decoder": "tfx"}, "decoder: expected 'tfi' or 'tfp', got 'tfx'"),
        ("RealRawVSR", {"width": 12}, "width: expected a multiple of 8, .*, got 12"),
        ("SpikeSRNetLike", {"frames": 43}, "frames: expected 13 plus a multiple of 14, such as 41, got 43"),
        ("SwinIR", {"width": 12, "heads": 5}, "heads: expected a divisor of width = 12, got 5"),
        ("TSCNN", {"width": 12}, "width: expected a multiple of 8, got 12"),
        ("VidarSR", {"frames": 40}, "frames: expected an odd number, 9 or more, got 40"),
    ],
)
def test_invalid_settings_are_rejected(name, settings, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        getattr(networks, name)(**settings)

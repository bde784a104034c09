import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from lightning_modules.motion import Spike2Flow
from lightning_modules.motion.recurrent import Correlation, GlobalAttention
from lightning_modules.networks import CSCSR
from spikekit import spike_interval, split_bayer

TIMES = (5, 20, 35)
TINY = {"features": 4, "hidden": 4, "motion": 4, "head": 4, "widths": (4, 6), "correlation": (4, 4), "iterations": 2}
PAPER = {"window": 21, "widths": (64, 96, 128), "blocks": 2, "features": 216, "attention": 128, "hidden": 128}
PAPER |= {"correlation": (196, 160), "motion": 96, "head": 196, "levels": 3, "radius": 3, "iterations": 8}


def clip(batch=1, height=16, width=20, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(batch, 41, height, width, generator=generator) < 0.3).to(torch.uint8)


def test_parameters_of_the_paper_and_multiplications_of_the_default_size():
    with torch.device("meta"):
        network = Spike2Flow(**PAPER)
    assert sum(p.numel() for p in network.parameters()) == 6_603_718 - 101_888
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        Spike2Flow()(clip(1, 48, 48), TIMES, "RGGB")
    assert counter.get_total_flops() / 2 / 48**2 < 0.3e6


@pytest.mark.parametrize(("size", "value"), [((2, 3), 0), ((7, 13), None), ((9, 6), 1), ((40, 40), None)])
def test_any_size_and_any_spikes_without_nan(size, value):
    network = Spike2Flow(**{**TINY, "levels": 4, "attention": 4})
    with torch.no_grad():
        network.network.features[-1].gain.fill_(1.0)
    spikes = clip(2, *size)
    spikes = spikes if value is None else torch.full_like(spikes, value)
    flows = network(spikes, TIMES, "RGGB")
    sites = network.channel_flows(spikes, TIMES, "RGGB")
    for flow, site in zip(flows, sites, strict=True):
        assert flow.shape == (2, 2, *size)
        assert site.shape == (4, 2, 2, *((side + 1) // 2 for side in size))
        assert flow.isfinite().all()
    sum(flow.square().sum() for flow in flows).backward()
    assert all(p.grad.isfinite().all() for p in network.parameters())


class Known(torch.nn.Module):
    """Substitute for the network: records its input, and returns flows x of 1, 2, 3 cells, with y three times x."""

    stride = 4

    def forward(self, windows, iterations):
        self.windows = windows
        flow = torch.tensor([1.0, 2, 3])[:, None] * torch.tensor([1.0, 3.0])
        flow = flow.reshape(1, 3, 2, 1, 1).expand(len(windows), 3, 2, *windows.shape[-2:])
        # time-reversed streams have even indices
        sign = torch.tensor([-1.0, 1.0]).repeat(len(windows) // 2).reshape(-1, 1, 1, 1, 1)
        return [0 * flow, sign * flow]


def test_result_is_the_third_flow_of_the_last_iteration_in_sensor_pixels():
    estimator = Spike2Flow(**TINY)
    estimator.network = Known()
    estimator.register_parameter("dtype", torch.nn.Parameter(torch.zeros(1)))
    spikes = clip(3, 10, 7)
    to_first, to_last = estimator(spikes, TIMES, "GRBG")
    expected = torch.tensor([2 * 3.0, 2 * 9.0]).reshape(1, 2, 1, 1).expand(3, 2, 10, 7)
    assert to_last.equal(expected)
    assert to_first.equal(-expected)


def test_windows_hold_intervals_around_four_times():
    estimator = Spike2Flow(**{**TINY, "window": 21})
    estimator.network = Known()
    estimator.register_parameter("dtype", torch.nn.Parameter(torch.zeros(1)))
    spikes = clip(2, 8, 6)
    estimator(spikes, TIMES, "GBRG")
    seen = estimator.network.windows.unflatten(0, (4, 2, 2))
    for direction, stream in enumerate((spikes.flip(1), spikes)):
        sites = spike_interval(split_bayer(stream, "GBRG"))
        for number, center in enumerate((20, 25, 30, 35)):
            frames = [min(center + offset, 40) for offset in range(-10, 11)]
            assert seen[:, :, direction, number].equal(sites[:, :, frames].float())


def test_result_does_not_depend_on_the_batch(monkeypatch):
    estimator = Spike2Flow(**TINY)
    spikes = clip(3)
    whole = estimator(spikes, TIMES, "RGGB")
    monkeypatch.setattr("lightning_modules.motion.spike2flow._PIXELS", 1)
    for flow, expected in zip(estimator(spikes[1:2], TIMES, "RGGB"), whole, strict=True):
        torch.testing.assert_close(flow, expected[1:2], rtol=1e-4, atol=1e-5)


def test_every_parameter_has_a_gradient():
    estimator = Spike2Flow(**{**TINY, "attention": 4, "blocks": 2, "motion": 8})
    with torch.no_grad():
        for encoder in (estimator.network.features, estimator.network.context):
            encoder[-1].gain.fill_(0.5)  # initialised with 0
    flows = estimator.refinements(clip(), TIMES, "RGGB")
    sum((flow - 1).abs().mean() for flow in flows).backward()
    for name, parameter in estimator.named_parameters():
        before_norm = name.endswith("bias") and parameter.grad.abs().max() < 1e-6  # normalisation removes such a bias
        assert before_norm or parameter.grad.abs().sum() > 0, name
    assert sum(p.grad.abs().sum() > 1e-6 for p in estimator.parameters()) > 40


@pytest.fixture(params=[1600, 0], ids=["all pairs", "looked up"])
def _kind(request, monkeypatch):
    monkeypatch.setattr("lightning_modules.motion.recurrent._ALL_PAIRS", request.param)


@pytest.mark.usefixtures("_kind")
def test_half_precision_looks_up_exact_positions():
    here = torch.ones(1, 1, 1, 700, dtype=torch.bfloat16)
    there = torch.zeros(1, 1, 1, 1, 700, dtype=torch.bfloat16)
    there[..., 601] = 1
    flow = torch.tensor([0.25, 0]).reshape(1, 2, 1, 1).expand(1, 2, 1, 700)
    found = Correlation(here, there, levels=1, radius=0)(flow)
    torch.testing.assert_close(found[0, 0, 0, 599:603], torch.tensor([0.0, 0.25, 0.75, 0.0]))


def test_attention_against_brute_force():
    attention = GlobalAttention(3, 2).double()
    x = torch.randn(1, 3, 2, 4, dtype=torch.float64)
    assert attention(x).equal(x)
    attention.gain.data.fill_(0.5)
    normed = torch.nn.functional.instance_norm(x).flatten(2)[0].T
    query, key = (normed @ attention.query_key.weight[part, :, 0, 0].T for part in (slice(8), slice(8, 16)))
    weights = (query @ key.T / 2**0.5).softmax(dim=1)
    found = weights @ (normed @ attention.value.weight[..., 0, 0].T) @ attention.project.weight[..., 0, 0].T
    torch.testing.assert_close(attention(x), x + 0.5 * found.T.reshape(1, 3, 2, 4))


def checkpoint(path, estimator, **changes):
    weights = {f"network.{name}": value for name, value in estimator.state_dict().items()}
    content = {"state_dict": weights, "network": {"class": "Spike2Flow", **estimator.settings}}
    torch.save({**content, **changes}, path)
    return path


@pytest.mark.parametrize("frozen", [True, False])
def test_weights_can_be_used_in_cscsr(frozen, tmp_path):
    torch.manual_seed(1)
    trained = Spike2Flow(**TINY)
    path = checkpoint(tmp_path / "flow.ckpt", trained)
    estimator = Spike2Flow(**{**TINY, "iterations": 1}, weights=path, frozen=frozen)
    trained.iterations = 1
    network = CSCSR(2, width=4, representation_width=4, features=1, stages=1, end_blocks=1, motion=estimator)
    network.train()
    spikes = clip(1, 12, 12)
    flow = network.estimate_flow(spikes)
    torch.testing.assert_close(flow, torch.stack(trained(spikes, TIMES, "RGGB"), dim=1))
    network(spikes).square().mean().backward()
    grads = [p.grad for p in estimator.parameters()]
    if frozen:
        assert not flow.requires_grad
        assert all(grad is None for grad in grads)
        assert not any(p.requires_grad for p in estimator.parameters())
    else:
        assert all(grad is not None for grad in grads)
        assert any(grad.abs().sum() > 0 for grad in grads)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"window": 10}, "window: expected a positive odd number, got 10"),
        ({"motion": 3}, "motion: expected an even number"),
    ],
)
def test_invalid_arguments_are_rejected(arguments, message):
    with pytest.raises(ValueError, match=message):
        Spike2Flow(**{**TINY, **arguments})


def test_network_in_half_precision_can_estimate_motion():
    dtype = torch.bfloat16
    network = CSCSR(2, width=4, representation_width=4, features=1, stages=1, end_blocks=1, motion=Spike2Flow(**TINY))
    expected = network.estimate_flow(clip(1, 24, 24))
    flow = network.to(dtype).estimate_flow(clip(1, 24, 24).to(dtype))
    assert flow.dtype == dtype
    torch.testing.assert_close(flow.float(), expected, rtol=0, atol=0.05 * expected.abs().max().item())
    assert network(clip(1, 24, 24)).isfinite().all()

import pytest
import torch

from lightning_modules.motion import ClassicalFlow, MotionEstimator, Spike2Flow, ZeroFlow, classical
from spikekit import mosaic, spike_integrate_fire, tfp_at

TIMES = (5, 20, 35)


def moving(velocity, height=48, width=64, pattern="RGGB", frames=41, alpha=0.4):
    """Spikes of a smooth coloured texture that moves by ``velocity`` (x, y) in sensor pixels per clock."""
    generator = torch.Generator().manual_seed(1)
    waves = torch.rand(3, 12, 4, generator=generator, dtype=torch.float64)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    light = []
    for clock in range(frames):
        u, v = (axis - speed * (clock - frames // 2) for axis, speed in zip((x, y), velocity, strict=True))
        phase = sum((w - 0.5) * 1.2 * axis[..., None, None] for w, axis in ((waves[..., 0], u), (waves[..., 1], v)))
        rgb = (torch.cos(phase + 6.3 * waves[..., 2]) * waves[..., 3]).mean(-1).movedim(-1, 0) * 0.6 + 0.5
        light.append(alpha * mosaic(rgb.clamp(0, 1), pattern))
    charge = torch.rand(height, width, generator=generator)
    return spike_integrate_fire(torch.stack(light).float(), charge=charge)[0][None]


@pytest.mark.parametrize(("velocity", "pattern"), [((0.2, 0.0), "RGGB"), ((-0.1, 0.1), "GBRG")])
def test_classical_flow_finds_a_translation(velocity, pattern):
    to_first, to_last = ClassicalFlow()(moving(velocity, pattern=pattern), TIMES, pattern)
    truth = 15 * torch.tensor(velocity).reshape(1, 2, 1, 1)
    for flow, expected in ((to_first, -truth), (to_last, truth)):
        error = (flow - expected).norm(dim=1)[..., 8:-8, 8:-8]
        assert error.mean() < 0.2, error.mean()


@pytest.mark.parametrize("pairs", [1600, 0])
def test_weights_of_spike2flow_give_the_flow_that_they_were_trained_for(pairs, monkeypatch):
    """Correlations are of all pairs or looked up. The scene moves by (3.75, -3) pixels."""
    monkeypatch.setattr("lightning_modules.motion.recurrent._ALL_PAIRS", pairs)
    flow = Spike2Flow(weights="spike2flow")(moving((0.25, -0.2)), TIMES, "RGGB")[1][0]
    found = [*flow.mean((1, 2)).tolist(), *flow[:, 0, 0].tolist()]
    assert found == pytest.approx([4.221, -2.888, 4.171, -2.867], abs=0.005)


@pytest.mark.parametrize("around", [torch.autocast("cpu", torch.bfloat16), torch.device("meta")])
def test_classical_flow_ignores_autocast_and_the_default_device(around):
    spikes = moving((0.2, -0.1))
    expected = ClassicalFlow()(spikes, TIMES, "RGGB")
    with around:
        got = ClassicalFlow()(spikes, TIMES, "RGGB")
    assert all(torch.equal(flow, other) for flow, other in zip(got, expected, strict=True))
    assert all(flow.isfinite().all() for flow in ClassicalFlow()(spikes.bfloat16(), TIMES, "RGGB"))


@pytest.mark.parametrize("size", [(33, 35), (3, 3)])
def test_flow_has_the_size_of_the_clip(size):
    spikes = (torch.rand(2, 41, *size) < 0.4).to(torch.uint8)
    for estimator in (ClassicalFlow(), ZeroFlow()):
        for flow in estimator(spikes, TIMES, "RGGB"):
            assert flow.shape == (2, 2, *size)
            assert flow.isfinite().all()
        for flow in estimator.channel_flows(spikes, TIMES, "RGGB"):
            assert flow.shape == (4, 2, 2, *((side + 1) // 2 for side in size))
            assert flow.dtype == torch.float32


@pytest.mark.parametrize("bends", [False, True])
def test_flow_has_sharp_edges_and_is_not_linear_where_motion_bends(bends):
    """Upper and lower halves: at rest and moving; or moving, and starting to move in the middle of the clip."""
    texture = torch.rand(1, 1, 12, 16, generator=torch.Generator().manual_seed(0))
    texture = torch.nn.functional.interpolate(texture, size=(5 * 48, 5 * 64), mode="bilinear")
    even = torch.cat([texture.roll(clock - 20, dims=-1) for clock in range(41)])  # a fifth of a sensor pixel per clock
    upper, lower = (even, even.clone()) if bends else (texture.expand_as(even), even)
    if bends:
        lower[:20] = texture[0]
    light = torch.cat([upper[..., : 5 * 24, :], lower[..., 5 * 24 :, :]], dim=-2)
    light = 0.4 * torch.nn.functional.avg_pool2d(light.squeeze(1), 5)
    spikes = spike_integrate_fire(light, charge=torch.rand(48, 64))[0]
    to_first, to_last = ClassicalFlow()(spikes[None], TIMES, "RGGB")
    right, parted = to_last[0, 0, :, 8:-8], (to_first + to_last)[0, 0, :, 8:-8]
    if bends:
        assert parted[:20].abs().mean() < 0.05
        assert 1 < parted[28:].mean() < 4  # 3, blurred by the window of the middle picture
    else:
        assert right[:20].abs().mean() < 0.3
        assert (right[28:] - 3).abs().mean() < 0.3
        assert (to_first + to_last).abs().mean() < 0.03


def test_clips_of_a_batch_are_independent():
    dark = moving((0.2, 0.1), frames=101, alpha=0.05)
    bright = moving((0.2, 0.1), frames=101, alpha=0.8)
    both = torch.cat([dark, bright, moving((-0.2, 0.1), frames=101, alpha=0.05)])
    for estimate in (ClassicalFlow(), ClassicalFlow().channel_flows):
        together = estimate(both, (5, 50, 95), "RGGB")
        for n in range(3):
            alone = estimate(both[n : n + 1], (5, 50, 95), "RGGB")
            for flow, part in zip(together, alone, strict=True):
                torch.testing.assert_close(flow[..., n, :, :, :], part[..., 0, :, :, :])


def test_longer_windows_are_more_accurate_in_low_light(monkeypatch):
    """A mean of 0.02 spikes per frame; motion of half a pixel in ten clocks."""
    spikes, truth = moving((0.05, 0.02), frames=101, alpha=0.05), torch.tensor([0.05, 0.02]) * 45

    def error():
        return (ClassicalFlow()(spikes, (5, 50, 95), "RGGB")[1][0] - truth[:, None, None]).norm(dim=0).mean()

    longer = error()
    monkeypatch.setattr(classical, "_LIGHT", 0)
    assert longer < 0.7 * error()


@pytest.mark.parametrize("step", [3, 63, 512])
def test_noise_by_rate_is_the_variance_of_an_ideal_pixel(step):
    charge = (torch.arange(100_000, dtype=torch.float64) + 0.5) / 100_000
    light = torch.full((41, 1, len(charge)), (step + 0.5) / 1024, dtype=torch.float64)
    means = tfp_at(spike_integrate_fire(light, charge=charge.reshape(1, -1))[0].double(), 20, 13, order=3)
    assert classical.noise_by_rate(13)[step].item() == pytest.approx(means.var().item(), rel=1e-3)


def test_flicker_of_dark_pixels_gives_no_motion():
    """Pixels that fire about once per clip get little weight."""
    light = torch.full((41, 48, 48), 0.02)
    spikes = spike_integrate_fire(light, charge=torch.rand(48, 48, generator=torch.Generator().manual_seed(0)))[0][None]
    far = ClassicalFlow(attachment=1e6)(spikes, TIMES, "RGGB")[1].norm(dim=1).mean()
    assert ClassicalFlow()(spikes, TIMES, "RGGB")[1].norm(dim=1).mean() < 0.2 * far


def test_static_bayer_pattern_gives_no_motion():
    """Residues of the static filter array would bias the flow towards zero."""
    colour = torch.tensor([0.9, 0.3, 0.1])[:, None, None].expand(3, 24, 24)
    light = 0.4 * mosaic(colour, "RGGB").expand(41, 24, 24)
    grey = ClassicalFlow()(spike_integrate_fire(light, charge=torch.rand(24, 24))[0][None], TIMES, "RGGB")
    assert all(flow.abs().max() < 0.3 for flow in grey)


class Constant(MotionEstimator):
    """Constant flows, different for each sub-stream."""

    def channel_flows(self, spikes, times, pattern):
        height, width = ((side + 1) // 2 for side in spikes.shape[-2:])
        flow = torch.tensor([[1.0, 2], [3, 4], [5, 6], [7, 12]]).reshape(4, 1, 2, 1, 1)
        flow = flow.expand(4, len(spikes), 2, height, width)
        return -flow, flow


def test_joint_flow_is_the_mean_of_the_sub_streams_in_sensor_pixels():
    to_first, to_last = Constant()(torch.zeros(3, 41, 8, 9), TIMES, "RGGB")
    expected = torch.tensor([8.0, 12]).reshape(1, 2, 1, 1).expand(3, 2, 8, 9)
    assert to_last.equal(expected)
    assert to_first.equal(-expected)


@pytest.mark.parametrize(
    ("size", "times", "message"),
    [
        ((1, 8, 8), (0, 0, 0), "with frames before and after the middle, 0"),
        ((41, 8, 8), (0, 40, 40), "with frames before and after the middle, 40"),
        ((41, 1, 8), TIMES, "at least 2 x 2 pixels"),
    ],
)
def test_classical_flow_rejects_clips_that_are_too_small_or_too_short(size, times, message):
    with pytest.raises(ValueError, match=message):
        ClassicalFlow()(torch.zeros(1, *size), times, "RGGB")

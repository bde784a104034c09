import numpy as np
import pytest
import torch
from skimage.registration import optical_flow_tvl1

from spikekit import kernels
from spikekit.flow.tvl1 import refine, tvl1_flow

needs_numba = pytest.mark.skipif(not kernels.NUMBA, reason="needs Numba")

FORWARD = torch.tensor([[0.0, 1.0]])


def moved(velocity, height=48, width=64, times=(0.0, 1.0), seed=1, count=1):
    """Smooth textures, (count, 2, H, W) in float64, that move by ``velocity`` (x, y) per unit of time."""
    waves = torch.rand(count, 3, 24, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")

    def at(time):
        u, v = x - velocity[0] * time, y - velocity[1] * time
        phase = sum((w - 0.5)[..., None, None] * axis for w, axis in ((waves[:, 0], u), (waves[:, 1], v)))
        return 0.3 + 0.5 * torch.cos(phase + 6.3 * waves[:, 2, :, None, None]).mean(dim=1)

    return torch.stack([at(time) for time in times], dim=1)


def steady(pictures, value=60.0):
    return torch.full_like(pictures[:, 0], value)


@pytest.mark.parametrize(
    ("times", "velocity"), [((0.0, 1.0), (0.3, 0.0)), ((-0.4, 0.6), (-1.5, 2.0)), ((1.0, 0.0), (3.0, -2.0))]
)
def test_a_translation_is_found(times, velocity):
    pictures = moved(velocity, times=times)
    flow = tvl1_flow(pictures, torch.tensor([times]), steady(pictures))
    error = (flow - torch.tensor(velocity).reshape(2, 1, 1)).norm(dim=1)[..., 10:-10, 10:-10]
    assert error.mean() < 0.05, error.mean()


@needs_numba
@pytest.mark.parametrize(
    ("dtype", "size"), [(torch.float64, (33, 35)), (torch.float32, (17, 5)), (torch.float64, (2, 2))]
)
def test_compiled_loops_equal_tensor_operations(dtype, size):
    """For a batch of different motion, weights, times and initial flow."""
    still, far = moved((0.0, 0.0), *size), moved((1.5, -0.7), *size)
    pictures = torch.cat([still, far, far.flip(-1)]).to(dtype)
    generator = torch.Generator().manual_seed(0)
    limit, flow = (torch.rand(3, *lead, *size, generator=generator, dtype=dtype) for lead in ((), (2,)))
    times = torch.tensor([[-0.5, 0.5], [0.0, 1.0], [-0.4, 0.6]])
    expected = refine(pictures, times, 40 * limit, flow, 3)
    compiled = kernels.import_loops("spikekit.flow.cpu_tvl1")
    got = compiled.refine(pictures, times, 40 * limit, flow, 3)
    assert got.dtype == dtype
    difference = (got - expected).abs()
    assert difference.mean() < (1e-12 if dtype == torch.float64 else 1e-4), difference.mean()
    assert not flow.equal(got)


@pytest.mark.parametrize("numba", [False, pytest.param(True, marks=needs_numba)])
class TestBothPaths:
    @pytest.fixture(autouse=True)
    def path(self, monkeypatch, numba):
        monkeypatch.setattr(kernels, "NUMBA", numba)

    def test_a_batch_is_its_members(self):
        pictures = torch.cat([moved((0.1, 0.0)), moved((3.0, -2.0)), moved((0.0, 0.0))])
        together = tvl1_flow(pictures, FORWARD.expand(3, 2), steady(pictures))
        for one, flow in zip(pictures.split(1), together.split(1), strict=True):
            torch.testing.assert_close(tvl1_flow(one, FORWARD, steady(one)), flow)

    def test_initial_flow_is_refined(self):
        pictures = moved((6.0, 0.0))
        truth = torch.zeros_like(pictures) + torch.tensor([6.0, 0.0]).reshape(2, 1, 1)
        flow = tvl1_flow(pictures, FORWARD, steady(pictures), truth)
        assert (flow - truth)[..., 10:-10, 10:-10].abs().mean() < 0.1
        assert not tvl1_flow(pictures * 0, FORWARD, steady(pictures), truth * 0).any()

    def test_pixels_without_weight_are_ignored(self):
        """If only the left half moves and only the right half has weight, there is no motion."""
        pictures = moved((0.0, 0.0))
        pictures[..., :24] = moved((1.0, 0.0))[..., :24]
        weight = steady(pictures)
        weight[..., :32] = 0
        assert tvl1_flow(pictures, FORWARD, weight).abs().max() < 0.05

    def test_uniform_pictures_give_no_motion(self):
        for level in (0.0, 0.3):
            pictures = torch.full((2, 2, 20, 20), level)
            assert not tvl1_flow(pictures, FORWARD.expand(2, 2), steady(pictures)).any()

    @pytest.mark.parametrize("wrong", [float("nan"), float("inf"), 1e30])
    def test_invalid_pixels_cause_no_memory_error(self, wrong):
        pictures = moved((1.0, 0.0)).float()
        pictures[0, 0, 10, 10] = wrong
        assert tvl1_flow(pictures, FORWARD, steady(pictures)).shape == (1, 2, 48, 64)


def energy(pictures, flow, attachment):
    """Energy of the minimisation problem in plain NumPy, not linearised."""
    from scipy.ndimage import map_coordinates

    first, second = pictures.numpy()
    grid = np.mgrid[: first.shape[0], : first.shape[1]] + flow[::-1]
    differs = map_coordinates(second, grid, order=1, mode="nearest") - first
    variation = sum(
        np.hypot(np.diff(part, axis=0, append=part[-1:]), np.diff(part, axis=1, append=part[:, -1:])).sum()
        for part in flow
    )
    return attachment * np.abs(differs).sum() + variation


def test_energy_is_as_low_as_that_of_scikit_image():
    pictures = moved((1.4, -0.8))
    pictures[..., 20:30, 20:40] = moved((-1.0, 0.5), seed=2)[..., 20:30, 20:40]
    pictures = pictures + 0.02 * torch.randn(pictures.shape, generator=torch.Generator().manual_seed(0))
    ours = tvl1_flow(pictures, FORWARD, steady(pictures, 30.0))[0].numpy()
    first, second = pictures[0].numpy()
    down, right = optical_flow_tvl1(first, second, attachment=30, num_warp=20, num_iter=50, tol=0)
    got, theirs = (energy(pictures[0], flow, 30) for flow in (ours, np.stack([right, down])))
    assert got < 1.1 * theirs, (got, theirs)
    assert got < 0.75 * energy(pictures[0], 0 * ours, 30)


def test_no_gradient_is_kept():
    pictures = moved((1.0, 0.0)).requires_grad_()
    assert not tvl1_flow(pictures, FORWARD, steady(pictures)).requires_grad

"""The search for known pixels, by Numba and by PyTorch, against brute force in integers."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch

from spikekit import bayer_mask
from spikekit.warp.neighbors import nearest_known

UNIT = 64  # flows below are multiples of 1 / UNIT, squared distances are whole numbers in units of 1 / UNIT^2


def brute(flow, mask, neighbors):
    """Return sorted indices (N, K, H W), the nearest, and weights, from all squared distances."""
    height, width = mask.shape
    rows, columns = np.nonzero(np.asarray(mask))
    y, x = np.mgrid[:height, :width].reshape(2, -1, 1)
    moved = np.rint(np.asarray(flow.double().flatten(2)) * UNIT).astype(np.int64)[..., None]
    square = (columns * UNIT - x * UNIT - moved[:, 0]) ** 2 + (rows * UNIT - y * UNIT - moved[:, 1]) ** 2
    nearest = np.argsort(square, axis=-1, kind="stable")[..., :neighbors]
    distance = np.sqrt(np.take_along_axis(square, nearest, -1))
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(distance[..., :1] == 0, distance == 0, distance[..., :1] / distance)
    weight /= weight.sum(-1, keepdims=True)
    return (rows * width + columns)[nearest], weight


def check(flow, mask, neighbors=4):
    expected, share = brute(flow, mask, neighbors)
    index, weight = (a.movedim(1, -1).numpy() for a in nearest_known(flow, mask, neighbors))
    assert index.shape[-1] == neighbors
    known = expected.shape[-1]
    assert (weight[..., known:] == 0).all()
    assert (index[..., known:] == index[..., :1]).all()
    assert (index[..., 0] == expected[..., 0]).all()
    order, expected_order = index[..., :known].argsort(-1), expected.argsort(-1)
    np.testing.assert_array_equal(
        np.take_along_axis(index, order, -1), np.take_along_axis(expected, expected_order, -1)
    )
    np.testing.assert_allclose(
        np.take_along_axis(weight, order, -1), np.take_along_axis(share, expected_order, -1), rtol=1e-6, atol=1e-7
    )


@pytest.fixture(params=["Numba", "PyTorch"])
def path(request, without_kernels):
    with without_kernels(nearest_known) if request.param == "PyTorch" else nullcontext():
        yield request.param


def masks():
    """Masks: products of at least four rows and four columns, and unions of two."""
    for pattern, scale in [("GRBG", 1), ("BGGR", 2), ("GBRG", 3)]:
        for colour, mask in zip(
            "RGB", bayer_mask(8 // min(scale, 2), 10 // min(scale, 2), pattern, scale=scale), strict=True
        ):
            yield pytest.param(mask, id=f"{pattern}{scale}{colour}")
    random = torch.Generator().manual_seed(5)
    for density in (0.2, 0.6):
        columns = torch.rand(2, 13, generator=random) < density
        columns[0, 3:7] = columns[1, ::4] = True
        product = torch.cat([torch.arange(8) % 2, torch.randint(0, 3, (7,), generator=random)])
        rows = product == torch.arange(2)[:, None]
        both = [of_rows[:, None] & of_columns for of_rows, of_columns in zip(rows, columns, strict=True)]
        yield pytest.param(both[0], id=f"product {density}")
        yield pytest.param(both[0] | both[1], id=f"two products {density}")
    yield pytest.param(torch.ones(7, 9), id="all")


@pytest.mark.parametrize("mask", list(masks()))
def test_neighbours_at_every_eighth_of_a_pixel(mask, path):
    """Inside the picture, at its borders and outside, with many ties."""
    eighths = torch.cartesian_prod(torch.arange(8), torch.arange(8))[:, :, None, None] / 8
    for reach in (0, 2, 20):
        check(eighths + torch.randint(-reach - 1, reach + 1, (64, 2, *mask.shape)), mask)


@pytest.mark.parametrize("neighbors", [1, 3, 8, 30])
def test_any_number_of_neighbours(neighbors, path):
    for mask in (*bayer_mask(3, 4, scale=2), torch.rand(6, 8) < 0.3):
        check(torch.randint(-4 * UNIT, 4 * UNIT, (5, 2, *mask.shape)) / UNIT, mask, neighbors)


def test_float32_distances_are_compared_in_double(path):
    """Two distances whose difference is below the resolution of float32."""
    mask = torch.zeros(9, 9, dtype=torch.bool)
    mask[::4, ::4] = True
    tiny = 2.0**-26
    flow = torch.zeros(2, 2, 9, 9)
    flow[0, 0], flow[1, 0] = tiny, -tiny
    index, _ = nearest_known(flow, mask, 4)
    up, left, centre, right, down = 4, 36, 40, 44, 76
    for nearest, expected in zip(
        index[:, :, centre], ({centre, right, up, down}, {centre, left, up, down}), strict=True
    ):
        assert set(nearest.tolist()) == expected

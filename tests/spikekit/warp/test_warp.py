"""The warps against brute force over all pixels, with distances in whole numbers, so that ties are exact."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.autograd import gradcheck, gradgradcheck

from spikekit import bayer_mask, flow_warp, flow_warp_idw
from spikekit.warp.warp import _bilinear

UNIT = 4096  # the flows below are multiples of 1 / UNIT


def idw_brute(features, flow, mask, neighbors):
    """Search all known pixels of (B, C, H, W) for every position; float64, and integers in units of 1 / UNIT."""
    features, flow, mask = (np.asarray(a.detach().double()) for a in (features, flow, mask))
    rows, columns = np.nonzero(mask)  # row-major
    moved = np.rint(flow * UNIT).astype(np.int64)
    assert (moved == flow * UNIT).all()
    result = np.zeros(features.shape)
    for b, y, x in np.ndindex(flow.shape[0], *flow.shape[2:]):
        dx = columns * UNIT - (x * UNIT + moved[b, 0, y, x])
        dy = rows * UNIT - (y * UNIT + moved[b, 1, y, x])
        square = dx * dx + dy * dy
        nearest = np.argsort(square, kind="stable")[:neighbors]
        if square[nearest[0]] == 0:
            nearest, weight = nearest[:1], np.ones(1)
        else:
            weight = 1 / np.sqrt(square[nearest].astype(np.float64))
        result[b, :, y, x] = features[b][:, rows[nearest], columns[nearest]] @ weight / weight.sum()
    return torch.from_numpy(result)


def flows(height, width, dtype=torch.float64):
    """Zero, whole, half (ties), quarter, any, far outside and very far outside: (7, 2, height, width)."""

    def draw(most, unit):
        return torch.randint(-most * unit, most * unit + 1, (2, height, width)).to(dtype) / unit

    return torch.stack([draw(0, 1), draw(3, 1), draw(3, 2), draw(2, 4), draw(4, UNIT), draw(50, 8), draw(10000, 2)])


def check_idw(mask, neighbors, dtype=torch.float64, rtol=1e-12):
    flow = flows(*mask.shape, dtype)
    features = torch.randn(len(flow), 2, *mask.shape, dtype=dtype)
    warped = flow_warp_idw(features, flow, mask, neighbors=neighbors)
    assert warped.dtype == dtype
    torch.testing.assert_close(warped.double(), idw_brute(features, flow, mask, neighbors), rtol=rtol, atol=rtol)


@pytest.mark.parametrize("pattern", ["RGGB", "GBRG"])
@pytest.mark.parametrize(("scale", "neighbors"), [(1, 4), (3, 4), (4, 4), (1, 6), (2, 5)])
def test_idw_of_bayer_masks(pattern, scale, neighbors):
    for mask in bayer_mask(3, 4 if scale > 2 else 5, pattern, scale=scale):
        check_idw(mask, neighbors)


@pytest.mark.parametrize("neighbors", [1, 4, 6])
@pytest.mark.parametrize("density", [0.05, 0.3, 1])
@pytest.mark.parametrize("size", [(7, 9), (1, 11), (8, 1)])
def test_idw_of_any_mask(neighbors, density, size):
    mask = torch.rand(size) < density
    mask[-1, 0] = True
    check_idw(mask, neighbors)


@given(st.integers(0, 2**20 - 1), st.integers(1, 7))
def test_idw_of_every_small_mask(bits, neighbors):
    mask = torch.tensor([bits >> i & 1 for i in range(20)]).reshape(4, 5)
    if bits:
        check_idw(mask, neighbors)
    else:
        with pytest.raises(ValueError, match="mask"):
            check_idw(mask, neighbors)


def test_idw_takes_features_and_flow_of_two_dtypes():
    features, flow, mask = torch.randn(5, 2, 6, 8).half(), flows(6, 8, torch.float32)[:5], bayer_mask(6, 8)[1]
    warped = flow_warp_idw(features, flow, mask)
    assert warped.dtype == torch.float16
    torch.testing.assert_close(warped.double(), idw_brute(features, flow, mask, 4), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("kind", ["bayer", "random"])
def test_idw_reads_known_pixels_only(kind):
    mask = bayer_mask(4, 5, scale=2, dtype=torch.bool)[0] if kind == "bayer" else torch.rand(8, 10) < 0.2
    flow = flows(8, 10)
    features = torch.randn(len(flow), 2, 8, 10, dtype=torch.float64, requires_grad=True)
    warped = flow_warp_idw(features, flow, mask)
    assert torch.equal(flow_warp_idw(features.masked_fill(~mask, float("nan")), flow, mask), warped)
    known = features[..., mask]
    low, high = known.amin(-1)[..., None, None], known.amax(-1)[..., None, None]
    assert ((warped >= low - 1e-12) & (warped <= high + 1e-12)).all()
    (grad,) = torch.autograd.grad(warped.sum(), features)
    assert (grad[..., ~mask] == 0).all()
    assert grad.sum().item() == pytest.approx(warped.numel())  # the weights of a pixel add up to one


@pytest.mark.parametrize("channels", [1, 9])
def test_idw_second_gradient_is_finite(channels):
    """On known pixels and at ties as well."""
    features, flow = torch.randn(2, channels, 4, 6).requires_grad_(), torch.zeros(2, 2, 4, 6)
    flow[1] = 0.5
    flow.requires_grad_()
    warped = flow_warp_idw(features, flow, bayer_mask(4, 6)[1])
    grads = torch.autograd.grad(warped.square().sum(), (features, flow), create_graph=True)
    for grad in torch.autograd.grad(sum(grad.square().sum() for grad in grads), (features, flow)):
        assert grad.isfinite().all()


@pytest.mark.parametrize("channels", [2, 9])
def test_idw_keeps_the_memory_format(channels):
    features, flow, mask = torch.randn(2, channels, 6, 8), torch.randn(2, 2, 6, 8), bayer_mask(6, 8)[1]
    expected = flow_warp_idw(features, flow, mask)
    assert expected.is_contiguous()
    last = features.contiguous(memory_format=torch.channels_last).requires_grad_()
    warped = flow_warp_idw(last, flow, mask)
    assert warped.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(warped, expected)
    (grad,) = torch.autograd.grad(warped, last, torch.ones_like(warped))
    assert grad.is_contiguous(memory_format=torch.channels_last)


def test_numbers_of_numpy():
    args = torch.rand(1, 1, 6, 8), torch.rand(1, 2, 6, 8), bayer_mask(6, 8)[0]
    for number in (np.int64(4), np.uint8(4), torch.tensor(4)):
        assert torch.equal(flow_warp_idw(*args, neighbors=number), flow_warp_idw(*args, neighbors=4))


def test_idw_remembers_masks_but_not_too_well():
    """The tables of a mask are kept between calls; a mask that changes, or another number, must not get old ones."""
    features, flow = torch.randn(1, 1, 6, 8, dtype=torch.float64), flows(6, 8)[4:5]
    mask = (torch.rand(6, 8) < 0.3).double()
    for neighbors in (2, 4, 4, 3):
        torch.testing.assert_close(
            flow_warp_idw(features, flow, mask, neighbors=neighbors), idw_brute(features, flow, mask, neighbors)
        )
    mask[:3] = 1 - mask[:3]
    torch.testing.assert_close(flow_warp_idw(features, flow, mask), idw_brute(features, flow, mask, 4))
    for _ in range(20):  # the memory of a mask that is gone is soon another's
        mask = torch.rand(6, 8) < 0.3
        mask[0, 0] = True
        torch.testing.assert_close(flow_warp_idw(features, flow, mask), idw_brute(features, flow, mask, 4))


@pytest.mark.parametrize("channels", [1, 9])
def test_idw_sees_a_mask_change_through_other_names(channels):
    """NumPy's view of the same memory and ``mask.data`` do not count their changes."""
    features, flow = torch.rand(1, channels, 6, 8), 3 * torch.rand(1, 2, 6, 8) - 1.5
    for other in (lambda mask: mask.numpy(), lambda mask: mask.data):
        mask = bayer_mask(6, 8)[0].clone()
        before = flow_warp_idw(features, flow, mask)
        other(mask)[:] = other(bayer_mask(6, 8)[2])
        after = flow_warp_idw(features, flow, mask)
        assert not torch.equal(after, before)
        assert torch.equal(after, flow_warp_idw(features, flow, bayer_mask(6, 8)[2]))


def test_idw_under_inference_mode():
    features, flow, kept = torch.randn(1, 1, 6, 8, dtype=torch.float64), flows(6, 8)[4:5], bayer_mask(6, 8)[1]
    with torch.inference_mode():
        mask = bayer_mask(6, 8)[1]
        expected = flow_warp_idw(features, flow, mask)
        mask.zero_()
        mask[0, 0] = 1
        torch.testing.assert_close(flow_warp_idw(features, flow, mask), features[..., :1, :1].expand(1, 1, 6, 8))
        assert torch.equal(flow_warp_idw(features, flow, kept), expected)
    flow = flow.clone().requires_grad_()
    warped = flow_warp_idw(features.clone(), flow, kept)
    assert torch.equal(warped, expected)
    warped.sum().backward()


def bilinear_loop(image, flow):
    """Bilinear interpolation at positions that are moved to the border."""
    image, flow = image.numpy(), flow.numpy()
    height, width = image.shape[-2:]
    result = np.zeros(image.shape)
    for b, y, x in np.ndindex(len(image), height, width):
        px, py = min(max(x + flow[b, 0, y, x], 0), width - 1), min(max(y + flow[b, 1, y, x], 0), height - 1)
        for j in range(height):
            for i in range(width):
                result[b, :, y, x] += max(0, 1 - abs(py - j)) * max(0, 1 - abs(px - i)) * image[b, :, j, i]
    return torch.from_numpy(result)


@pytest.mark.parametrize("size", [(5, 7), (1, 6), (4, 1), (1, 1)])
def test_flow_warp(size):
    flow = flows(*size)
    image = torch.randn(len(flow), 2, *size, dtype=torch.float64)
    torch.testing.assert_close(flow_warp(image, flow), bilinear_loop(image, flow), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(
        flow_warp(image.float(), flow.float())[:6], bilinear_loop(image, flow).float()[:6], rtol=1e-4, atol=1e-4
    )


IMAGE, FLOW, MASK = torch.rand(2, 3, 4, 6), torch.rand(2, 2, 4, 6), torch.ones(4, 6)


@pytest.mark.parametrize("op", [flow_warp, lambda f, w: flow_warp_idw(f, w, MASK)])
@pytest.mark.parametrize(
    ("error", "image", "flow"),
    [
        (TypeError, IMAGE.long(), FLOW),
        (TypeError, IMAGE, FLOW.long()),
        (TypeError, IMAGE.numpy(), FLOW),
        (ValueError, IMAGE, FLOW[:1]),
        (ValueError, IMAGE, FLOW[..., 1:]),
        (ValueError, IMAGE, IMAGE),
        (ValueError, IMAGE[0], FLOW),
        (ValueError, IMAGE[0, 0], FLOW[0, 0]),
    ],
)
def test_wrong_sizes(op, error, image, flow):
    with pytest.raises(error):
        op(image, flow)


@pytest.mark.parametrize("mask", [MASK * 0, MASK[1:], MASK[None].expand(3, 4, 6), None, MASK.numpy()])
def test_wrong_mask(mask):
    with pytest.raises(ValueError, match="mask"):
        flow_warp_idw(IMAGE, FLOW, mask)


@pytest.mark.parametrize("neighbors", [0, -1, 1.5, True])
def test_wrong_neighbors(neighbors):
    with pytest.raises(ValueError, match="neighbors"):
        flow_warp_idw(IMAGE, FLOW, MASK, neighbors=neighbors)


def test_bilinear_gather_is_flow_warp_with_second_derivatives():
    image, flow = torch.rand(2, 3, 5, 7).double(), 8 * torch.rand(2, 2, 5, 7).double() - 4
    flow[0, :, :2] = flow[0, :, :2].round()

    def gathered(image, flow):
        y, x = torch.meshgrid(torch.arange(5), torch.arange(7), indexing="ij")
        return _bilinear(image, x + flow[:, 0], y + flow[:, 1])

    leaves = image.requires_grad_(), flow.requires_grad_()
    assert torch.allclose(gathered(*leaves), flow_warp(*leaves), rtol=0, atol=1e-12)
    weight = torch.rand(2, 3, 5, 7).double()
    ours, theirs = (torch.autograd.grad(op(*leaves), leaves, weight) for op in (gathered, flow_warp))
    off_grid = (flow != flow.round()).all(dim=1, keepdim=True)  # on it the derivative is that of either side
    assert torch.allclose(ours[0], theirs[0], rtol=0, atol=1e-12)
    assert torch.allclose(ours[1] * off_grid, theirs[1] * off_grid, rtol=0, atol=1e-12)
    moved = tuple((leaf.detach() + 0.01 * k).requires_grad_() for k, leaf in enumerate(leaves))
    assert gradcheck(gathered, moved)
    assert gradgradcheck(gathered, moved)

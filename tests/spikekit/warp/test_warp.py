"""The warps: pixels that are read, caching of masks, derivatives; values are tested by the table of extremes."""

import brute_force
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from spikekit import bayer_mask, flow_warp, flow_warp_idw
from spikekit.warp.warp import _bilinear


def flows(height, width):
    """Flows (7, 2, height, width): zero, whole, half (ties), quarter, random, far outside and very far outside."""

    def draw(most, unit):
        return torch.randint(-most * unit, most * unit + 1, (2, height, width)).double() / unit

    return torch.stack([draw(0, 1), draw(3, 1), draw(3, 2), draw(2, 4), draw(4, 4096), draw(50, 8), draw(10000, 2)])


def exact(features, flow, mask, neighbors=4):
    arrays = (tensor.numpy() for tensor in (features[0], flow[0], mask))
    return torch.from_numpy(brute_force.idw(*arrays, neighbors)[0])[None]


@pytest.mark.parametrize("channels", [1, 9])
def test_idw_second_gradient_is_finite(channels):
    """Including known pixels and ties."""
    features, flow = torch.randn(2, channels, 4, 6).requires_grad_(), torch.zeros(2, 2, 4, 6)
    flow[1] = 0.5
    flow.requires_grad_()
    warped = flow_warp_idw(features, flow, bayer_mask(4, 6)[1])
    grads = torch.autograd.grad(warped.square().sum(), (features, flow), create_graph=True)
    for grad in torch.autograd.grad(sum(grad.square().sum() for grad in grads), (features, flow)):
        assert grad.isfinite().all()


def test_idw_cache_of_masks_follows_changes():
    """Cached tables must not be used for a changed mask or another number of neighbours."""
    features, flow = torch.randn(1, 1, 6, 8, dtype=torch.float64), flows(6, 8)[4:5]
    mask = (torch.rand(6, 8) < 0.3).double()
    for neighbors in (2, 4, 4, 3):
        torch.testing.assert_close(
            flow_warp_idw(features, flow, mask, neighbors=neighbors), exact(features, flow, mask, neighbors)
        )
    mask[:3] = 1 - mask[:3]
    torch.testing.assert_close(flow_warp_idw(features, flow, mask), exact(features, flow, mask))
    for _ in range(20):  # the memory of a mask that is gone is soon another's
        mask = torch.rand(6, 8) < 0.3
        mask[0, 0] = True
        torch.testing.assert_close(flow_warp_idw(features, flow, mask), exact(features, flow, mask))


@pytest.mark.parametrize("channels", [1, 9])
def test_idw_notices_changes_of_a_mask_through_views(channels):
    """Changes through NumPy or ``mask.data`` do not increment the version counter."""
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


IMAGE, FLOW, MASK = torch.rand(2, 3, 4, 6), torch.rand(2, 2, 4, 6), torch.ones(4, 6)


@pytest.mark.parametrize("op", [flow_warp, lambda f, w: flow_warp_idw(f, w, MASK)])
@pytest.mark.parametrize(
    ("error", "image", "flow"),
    [
        (TypeError, IMAGE, FLOW.long()),
        (ValueError, IMAGE, FLOW[:1]),
        (ValueError, IMAGE, FLOW[..., 1:]),
        (ValueError, IMAGE, IMAGE),
    ],
)
def test_wrong_sizes_are_rejected(op, error, image, flow):
    with pytest.raises(error):
        op(image, flow)


@pytest.mark.parametrize(
    ("mask", "neighbors", "name"),
    [
        *((mask, 4, "mask") for mask in (MASK * 0, MASK[1:], MASK[None].expand(3, 4, 6), None, MASK.numpy())),
        *((MASK, neighbors, "neighbors") for neighbors in (0, 1.5)),
    ],
)
def test_wrong_masks_and_neighbors_are_rejected(mask, neighbors, name):
    with pytest.raises(ValueError, match=name):
        flow_warp_idw(IMAGE, FLOW, mask, neighbors=neighbors)


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
    assert gradgradcheck(gathered, moved, fast_mode=True)

import copy

import pytest
import torch
from torch import nn

from lightning_modules.tasks.muon import MuonWithAdam, orthogonalized


def _steps(optimizer, parameter, gradients):
    for gradient in gradients:
        parameter.grad = gradient.clone()
        optimizer.step()
    return parameter.detach()


@pytest.mark.parametrize(("shape", "size"), [((6, 6), 1.0), ((12, 5), 1e-6), ((5, 12), 1e6)])
def test_orthogonalisation_keeps_singular_vectors(shape, size):
    left, _ = torch.linalg.qr(torch.randn(shape[0], 5, dtype=torch.float64))
    right, _ = torch.linalg.qr(torch.randn(shape[1], 5, dtype=torch.float64))
    values = torch.tensor([1.0, 0.7, 0.3, 0.1, 0.05], dtype=torch.float64)
    found = orthogonalized(size * left @ torch.diag(values) @ right.mT)
    inside = left.mT @ found @ right
    assert found.shape == shape
    assert torch.allclose(inside, torch.diag(inside.diag()), atol=1e-9)
    assert torch.allclose(left @ inside @ right.mT, found, atol=1e-9)
    assert 0.6 < inside.diag().min() <= inside.diag().max() < 1.3


def test_matches_torch_on_matrices():
    start, gradients = torch.randn(8, 20), torch.randn(4, 8, 20)
    ours, theirs = nn.Parameter(start.clone()), nn.Parameter(start.clone())
    reference = torch.optim.Muon([theirs], lr=1e-2, weight_decay=0, adjust_lr_fn="match_rms_adamw")
    moved = _steps(MuonWithAdam([ours], lr=1e-2), ours, gradients) - start
    expected = _steps(reference, theirs, gradients) - start
    assert (moved - expected).norm() < 0.02 * expected.norm()  # torch rounds to bfloat16 on the way


def test_convolution_is_a_matrix_with_one_row_per_output_channel():
    start, gradients = torch.randn(8, 4, 3, 3), torch.randn(3, 8, 4, 3, 3)
    whole, flat = nn.Parameter(start.clone()), nn.Parameter(start.flatten(1).clone())
    last = nn.Parameter(start.clone().contiguous(memory_format=torch.channels_last))
    expected = _steps(MuonWithAdam([flat]), flat, gradients.flatten(2))
    assert torch.equal(_steps(MuonWithAdam([whole]), whole, gradients).flatten(1), expected)
    assert torch.allclose(_steps(MuonWithAdam([last]), last, gradients).flatten(1), expected, atol=1e-6)


def test_layers_of_equal_shape_are_independent():
    shapes = [(8, 4, 3, 3), (8, 4, 3, 3), (6, 8), (8, 4, 3, 3), (8, 6), (5,)]
    start = [torch.randn(shape) for shape in shapes]
    gradients = [[10.0**n * torch.randn(shape) for n, shape in enumerate(shapes)] for _ in range(3)]
    together, alone = ([nn.Parameter(one.clone()) for one in start] for _ in range(2))
    optimizers = [MuonWithAdam(together, lr=1e-2), *(MuonWithAdam([one], lr=1e-2) for one in alone)]
    for step in gradients:
        for parameters in (together, alone):
            for parameter, gradient in zip(parameters, step, strict=True):
                parameter.grad = gradient.clone()
        together[1].grad = alone[1].grad = None  # one that does not learn
        for optimizer in optimizers:
            optimizer.step()
    assert torch.equal(together[1], start[1])
    for one, other in zip(together, alone, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("shape", [(7,), (16, 3), (3, 16, 3, 3), ()])
def test_biases_and_layers_with_three_channels_use_adam(shape):
    start, gradients = torch.randn(shape), torch.randn(5, *shape)
    ours, theirs = nn.Parameter(start.clone()), nn.Parameter(start.clone())
    reference = torch.optim.Adam([theirs], lr=1e-2, betas=(0.9, 0.99))
    expected = _steps(reference, theirs, gradients)
    assert torch.allclose(_steps(MuonWithAdam([ours], lr=1e-2), ours, gradients), expected, atol=1e-6)


def test_state_is_restored():
    start, gradients = [torch.randn(6, 5), torch.randn(6)], [(torch.randn(6, 5), torch.randn(6)) for _ in range(4)]

    def run(parameters, optimizer, part):
        for pair in part:
            for parameter, gradient in zip(parameters, pair, strict=True):
                parameter.grad = gradient.clone()
            optimizer.step()

    whole = [nn.Parameter(part.clone()) for part in start]
    run(whole, MuonWithAdam(whole), gradients)
    halves = [nn.Parameter(part.clone()) for part in start]
    first = MuonWithAdam(halves)
    run(halves, first, gradients[:2])
    again = MuonWithAdam(halves)
    again.load_state_dict(copy.deepcopy(first.state_dict()))
    run(halves, again, gradients[2:])
    assert all(map(torch.equal, whole, halves))

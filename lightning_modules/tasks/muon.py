"""Muon for convolutional networks; it needs fewer steps from random weights than Adam."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

# coefficients of an odd polynomial; applied repeatedly, it brings singular values in (0, 1] close to 1
_QUINTIC = 3.4445, -4.7750, 2.0315
_REPEATS = 5

_MOMENTUM, _BETAS, _EPS = 0.95, (0.9, 0.99), 1e-8


def orthogonalized(matrix: Tensor) -> Tensor:
    r"""Bring all singular values of a matrix close to 1, between 0.6 and 1.3, by Newton-Schulz iterations.

    Singular values of a thousandth of the largest or less stay smaller.

    Args:
        matrix: :math:`(*, M, N)`.

    Returns:
        :math:`(*, M, N)`, close to :math:`U V^T` for a matrix :math:`U S V^T`; zeros for a zero matrix.

    Example:
        >>> torch.linalg.svdvals(orthogonalized(torch.diag(torch.tensor([3.0, 2.0, 1.0])))).round(decimals=1)
        tensor([1.1000, 0.7000, 0.7000])
    """
    tall = matrix.shape[-2] > matrix.shape[-1]
    wide = matrix.mT if tall else matrix
    wide = wide / wide.norm(dim=(-2, -1), keepdim=True).clamp(min=torch.finfo(wide.dtype).tiny)
    first, third, fifth = _QUINTIC
    for _ in range(_REPEATS):
        gram = wide @ wide.mT
        wide = first * wide + (third * gram + fifth * gram @ gram) @ wide
    return wide.mT if tall else wide


class MuonWithAdam(torch.optim.Optimizer):
    """Muon for weights of layers; Adam for biases and for layers with at most three input or output channels.

    Muon orthogonalises the momentum of a weight as a matrix with one row per output channel, so that the step is
    equally large in all its directions. It extends ``torch.optim.Muon``, which takes only matrices, to convolutions,
    without weight decay and with ``match_rms_adamw``, so that learning rates for Adam fit.

    Args:
        params: parameters or parameter groups.
        lr: learning rate. The momentum of Muon is 0.95; the betas of Adam are 0.9 and 0.99, its eps is 1e-8.

    Raises:
        ValueError: the learning rate is out of range.

    Example:
        >>> layer = torch.nn.Conv2d(8, 8, 3)
        >>> optimizer = MuonWithAdam(layer.parameters(), lr=1e-3)
        >>> layer(torch.ones(1, 8, 5, 5)).mean().backward()
        >>> optimizer.step()

    Reference:
        Jordan et al., Muon: An optimizer for hidden layers in neural networks, 2024; Liu et al., Muon is Scalable for
        LLM Training, 2025, for the size of the step; Kingma and Ba, Adam, ICLR 2015.
    """

    def __init__(self, params: Iterable[Tensor] | Iterable[dict[str, Any]], lr: float = 1e-3) -> None:
        if not 0 <= lr < math.inf:
            raise ValueError(f"lr: expected 0 or more, got {lr}")
        super().__init__(params, {"lr": lr})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:
        """Perform one optimisation step.

        Args:
            closure: function that reevaluates the model and returns the loss.

        Returns:
            The loss of ``closure``, if given.
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            alike: dict[Any, list[Tensor]] = {}
            others: list[Tensor] = []
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                matrix = parameter.flatten(1).shape if parameter.ndim > 1 else ()
                if matrix and min(matrix) > 3:
                    alike.setdefault((matrix, parameter.dtype, parameter.device), []).append(parameter)
                else:
                    others.append(parameter)
            # on a GPU, one operation on all parameters is faster than one for each
            for parameters in alike.values():
                torch._foreach_add_(parameters, self._muon(parameters), alpha=-group["lr"])
            if others:
                torch._foreach_add_(others, self._adam(others), alpha=-group["lr"])
        return loss

    def _muon(self, parameters: list[Tensor]) -> list[Tensor]:
        """Return the steps for weights whose matrices have the same size."""
        for parameter in parameters:
            if not self.state[parameter]:
                self.state[parameter]["momentum"] = torch.zeros_like(parameter)
        momenta = [self.state[parameter]["momentum"] for parameter in parameters]
        gradients = [parameter.grad for parameter in parameters]
        torch._foreach_lerp_(momenta, gradients, 1 - _MOMENTUM)
        ahead = torch._foreach_lerp(gradients, momenta, _MOMENTUM)  # Nesterov momentum
        matrices = torch.stack([one.flatten(1) for one in ahead])
        changes = 0.2 * math.sqrt(max(matrices.shape[1:])) * orthogonalized(matrices)
        return [change.reshape(parameter.shape) for change, parameter in zip(changes, parameters, strict=True)]

    def _adam(self, parameters: list[Tensor]) -> list[Tensor]:
        first, second = _BETAS
        states = [self.state[parameter] for parameter in parameters]
        for state, parameter in zip(states, parameters, strict=True):
            if not state:
                state |= {"steps": 0, "mean": torch.zeros_like(parameter), "square": torch.zeros_like(parameter)}
            state["steps"] += 1
        gradients = [parameter.grad for parameter in parameters]
        means, squares = ([state[name] for state in states] for name in ("mean", "square"))
        torch._foreach_lerp_(means, gradients, 1 - first)
        torch._foreach_lerp_(squares, torch._foreach_mul(gradients, gradients), 1 - second)
        mean = torch._foreach_div(means, [1 - first ** state["steps"] for state in states])
        root = torch._foreach_sqrt(torch._foreach_div(squares, [1 - second ** state["steps"] for state in states]))
        return torch._foreach_div(mean, torch._foreach_add(root, _EPS))

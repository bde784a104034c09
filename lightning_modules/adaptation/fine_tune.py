"""Fine-tuning of a network on examples from a recording, and its evaluation on held-out examples."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from lightning_fabric.utilities import move_data_to_device
from torch import Tensor
from torch.utils.data import default_collate

from lightning_modules.adaptation.distillation import HELD_OUT, DistillationSet
from lightning_modules.inference.tiles import TILE, forward_in_tiles
from lightning_modules.networks import Network
from spikekit import psnr
from spikekit.color.cfa import GREY
from spikekit.progress import progress

_PATCH, _BATCH, _RATE = 40, 4, 1e-3
_RISING = 10  # warm-up steps of the learning rate, which then falls linearly to 0


def patch_of(examples: DistillationSet, pattern: str, scale: int, index: int) -> dict[str, Tensor]:
    """Return a random patch of an example, with its picture and flow; the index is the random seed."""
    rng = np.random.default_rng(index)
    one, sides = int(rng.integers(len(examples))), examples.spikes.shape[-2:]
    size = min(*sides, _PATCH)
    y, x = (2 * int(rng.integers((side - size) // 2 + 1)) for side in sides)
    here, there = (tuple(slice(k * z, k * (z + size)) for z in (y, x)) for k in (1, scale))
    patch = {"spikes": examples.spikes[one][..., *here], "rgb": examples.rgb[one][..., *there].float()}
    if examples.flow is not None:
        patch["flow"] = examples.flow[one][..., *here]
    if rng.uniform() < 0.5:  # reversed in time
        patch |= {name: patch[name].flip(0) for name in ("spikes", "flow") if name in patch}
    if pattern in ("RGGB", "BGGR", GREY) and rng.uniform() < 0.5:  # transposition keeps these patterns
        patch = {name: value.mT for name, value in patch.items()}
        if "flow" in patch:
            patch["flow"] = patch["flow"].flip(-3)
    return {name: value.contiguous() for name, value in patch.items()}


@torch.no_grad()
def likeness(network: Network, examples: DistillationSet) -> float:
    """Return the PSNR in dB of a network's pictures with respect to the teacher's, normalised to white and clamped."""
    values, device = [], next(network.parameters()).device
    for number in range(len(examples)):
        one = examples.part(slice(number, number + 1))
        flow = None if one.flow is None else one.flow.to(device)
        rgb = forward_in_tiles(network, one.spikes.to(device), TILE, flow=flow)
        shown = [(picture.float() / examples.white).clamp(0, 1) for picture in (rgb, one.rgb.to(device))]
        values.append(psnr(*shown).mean())
    return torch.stack(values).mean().item()


def fine_tune(
    student: Network, examples: DistillationSet, steps: int, precision: str = "32-true"
) -> tuple[float, float]:
    """Fine-tune a network on examples.

    Args:
        student: network to train, in evaluation mode.
        examples: examples; the last ones are held out.
        steps: training steps.
        precision: ``"32-true"`` or ``"bf16-mixed"``.

    Returns:
        PSNR in dB of the held-out pictures with respect to the teacher's, before and after.
    """
    taught, held_out = examples.part(slice(-HELD_OUT)), examples.part(slice(-HELD_OUT, None))
    before = likeness(student, held_out)
    device = next(student.parameters()).device
    optimizer = torch.optim.Adam(student.parameters(), lr=_RATE)
    student.train()
    for step in progress(range(steps), "steps", steps):
        patches = [patch_of(taught, student.pattern, student.scale, _BATCH * step + n) for n in range(_BATCH)]
        batch = move_data_to_device(default_collate(patches), device)
        optimizer.param_groups[0]["lr"] = _RATE * min(1, (step + 1) / _RISING) * (1 - step / (steps + 1))
        optimizer.zero_grad()
        with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16-mixed"):
            loss = F.l1_loss(student(batch["spikes"], batch.get("flow")), batch["rgb"])
        loss.backward()
        optimizer.step()
    return before, likeness(student.eval(), held_out)

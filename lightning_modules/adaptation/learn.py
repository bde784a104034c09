"""Train a network on lessons of a recording, and judge it by those that are held out."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from lightning_modules.adaptation.lessons import HELD_OUT, Lessons
from lightning_modules.inference.tiles import TILE, forward_in_tiles
from lightning_modules.networks import Network
from spikekit import psnr
from spikekit.arguments import one_line
from spikekit.color.cfa import GREY
from spikekit.io.failures import no_pipe
from spikekit.io.whole_file import whole_file
from spikekit.progress import progress

#: what is kept of a training that is interrupted
STATE = "state.safetensors"

_PATCH, _BATCH, _RATE = 40, 4, 1e-3
_RISING = 10  # steps until the rate is reached; then it falls to 0
_EVERY = 20  # steps from one state that is kept to the next
_MOMENTS = "exp_avg", "exp_avg_sq"  # of Adam


class Patches:
    """Patches of lessons, by chance; which, only the index says."""

    def __init__(self, lessons: Lessons, pattern: str, scale: int) -> None:
        self.lessons, self.scale = lessons, scale
        self.symmetric = pattern in ("RGGB", "BGGR", GREY)  # transposed, it begins with the same colours

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        rng = np.random.default_rng(index)
        one, s = int(rng.integers(len(self.lessons))), self.scale
        sides = self.lessons.spikes.shape[-2:]
        size = min(*sides, _PATCH)
        y, x = (2 * int(rng.integers((side - size) // 2 + 1)) for side in sides)
        here, there = (tuple(slice(k * z, k * (z + size)) for z in (y, x)) for k in (1, s))
        patch = {"spikes": self.lessons.spikes[one][..., *here], "rgb": self.lessons.rgb[one][..., *there].float()}
        if self.lessons.flow is not None:
            patch["flow"] = self.lessons.flow[one][..., *here]
        if rng.uniform() < 0.5:  # backwards in time
            patch |= {name: patch[name].flip(0) for name in ("spikes", "flow") if name in patch}
        if self.symmetric and rng.uniform() < 0.5:
            patch = {name: value.mT for name, value in patch.items()}
            if "flow" in patch:
                patch["flow"] = patch["flow"].flip(-3)
        return {name: value.contiguous() for name, value in patch.items()}


@torch.no_grad()
def likeness(network: Network, lessons: Lessons) -> float:
    """Return the PSNR in dB of pictures by a network to those of the teacher, as they would be shown."""
    values, device = [], next(network.parameters()).device
    for number in range(len(lessons)):
        one = lessons.part(slice(number, number + 1))
        flow = None if one.flow is None else one.flow.to(device)
        rgb = forward_in_tiles(network, one.spikes.to(device), TILE, flow=flow)
        shown = [(picture.float() / lessons.white).clamp(0, 1) for picture in (rgb, one.rgb.to(device))]
        values.append(psnr(*shown).mean())
    return torch.stack(values).mean().item()


def _rate(step: int, steps: int) -> float:
    return _RATE * min(1, (step + 1) / _RISING) * (1 - step / (steps + 1))


def learn(
    student: Network, lessons: Lessons, steps: int, folder: Path, precision: str = "32-true"
) -> tuple[float, float]:
    """Train a network on lessons; a training in the folder that was interrupted is resumed.

    Args:
        student: what learns, in evaluation mode.
        lessons: those that are held out last.
        steps: how long.
        folder: of the state that is kept.
        precision: ``"32-true"`` or ``"bf16-mixed"``.

    Returns:
        Likeness of the held-out pictures to the teacher's before and after, in dB.

    Raises:
        ValueError: what was kept is damaged, or of another network; the message is one line and names the file.
    """
    taught, held_out = lessons.part(slice(-HELD_OUT)), lessons.part(slice(-HELD_OUT, None))
    before = likeness(student, held_out)
    device = next(student.parameters()).device
    optimizer = torch.optim.Adam(student.parameters(), lr=_RATE)
    path, first = folder / STATE, 0
    if path.exists():
        first = _read_state(path, student, optimizer, steps)
    patches = Patches(taught, student.pattern, student.scale)
    mixed = torch.autocast(device.type, torch.bfloat16) if precision == "bf16-mixed" else nullcontext()
    student.train()
    for step in progress(range(first, steps), "steps", steps, initial=first):
        batch = [patches[_BATCH * step + n] for n in range(_BATCH)]
        clips, truth, flow = (_stacked(batch, name, device) for name in ("spikes", "rgb", "flow"))
        optimizer.param_groups[0]["lr"] = _rate(step, steps)
        optimizer.zero_grad()
        with mixed:
            loss = F.l1_loss(student(clips, flow), truth)
        loss.backward()
        optimizer.step()
        if (step + 1) % _EVERY == 0 or step + 1 == steps:
            _write_state(path, student, optimizer, step + 1)
    return before, likeness(student.eval(), held_out)


def _stacked(batch: list[dict[str, Tensor]], name: str, device: torch.device) -> Tensor | None:
    return torch.stack([one[name] for one in batch]).to(device) if name in batch[0] else None


def _tensors(student: Network, optimizer: torch.optim.Adam) -> dict[str, Tensor]:
    """All that a training changes, by name: the weights, and two moments of each."""
    found = {f"network.{name}": value for name, value in student.state_dict().items()}
    for name, weight in student.named_parameters():
        known = optimizer.state.get(weight, {})
        found |= {f"{moment}.{name}": known.get(moment, torch.zeros_like(weight)) for moment in _MOMENTS}
    return found


def _write_state(path: Path, student: Network, optimizer: torch.optim.Adam, step: int) -> None:
    tensors = {name: value.detach().cpu().clone() for name, value in _tensors(student, optimizer).items()}
    with whole_file(path) as file:
        file.write(save(tensors, {"step": json.dumps(step)}))


def _read_state(path: Path, student: Network, optimizer: torch.optim.Adam, steps: int) -> int:
    """Give network and optimizer the state that was kept, and return after how many steps it was."""
    try:
        with safe_open(no_pipe(path), "pt") as file:
            step = json.loads((file.metadata() or {})["step"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        check_state(tensors, _tensors(student, optimizer))
        if type(step) is not int or not 0 < step <= steps:
            raise ValueError(f"step: expected 1 .. {steps}, got {step!r:.80}")
    except Exception as error:  # what safetensors raises depends on the damage
        raise ValueError(f"{path}: not a state that lightning adapt resumes from ({one_line(error)[:300]})") from error
    own = {name: value for name, value in tensors.items() if name.startswith("network.")}
    student.load_state_dict({name.removeprefix("network."): value for name, value in own.items()})
    for name, weight in student.named_parameters():
        moments = {moment: tensors[f"{moment}.{name}"].to(weight.device) for moment in _MOMENTS}
        optimizer.state[weight] = {"step": torch.tensor(float(step)), **moments}
    return step


def check_state(found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Refuse tensors of other names, shapes or dtypes than a file of ours has, or such that are not finite.

    Raises:
        ValueError: which of them it is.
    """
    for name in sorted({*found, *expected}):
        if name not in found or name not in expected:
            raise ValueError(f"{name:.80}: {'missing' if name in expected else 'unknown'}")
        here, there = expected[name], found[name]
        if (here.shape, here.dtype) != (there.shape, there.dtype):
            wanted = f"{here.dtype} {tuple(here.shape)}"
            raise ValueError(f"{name:.80}: expected {wanted}, got {there.dtype} {tuple(there.shape)}")
        if not there.isfinite().all():
            raise ValueError(f"{name:.80}: expected finite numbers, got NaN or Inf")

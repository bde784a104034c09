"""Time of every operator compared with alternatives: ``python benchmarks/operators.py [OPERATOR ...]``.

Both sides of a row are timed in turn, in one process. The ratio is their time over ours: above 1, spikekit is faster.
"""

from __future__ import annotations

import argparse
import csv
import statistics
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from in_turn import interleave, ratio
from kornia.color import CFA, raw_to_rgb, rgb_to_raw
from kornia.filters import filter2d_separable
from torch import Tensor

import spikekit as sk
from spikekit.filters import separable_filter
from spikekit.timing import cpu_name, software, timer_of

ROOT = Path(__file__).parents[1]
HEADING = "operator", "case", "alternative", "ours (ms)", "its (ms)", "ratio", "lowest", "highest", "equal values"
Run = Callable[[], Any]
#: operator, case, ours, {alternative: theirs}; results are compared if both are tensors of one shape
Case = tuple[str, str, Run, dict[str, Run]]


class Inputs:
    """Inputs of the operators, with a fixed seed."""

    def __init__(self, device: torch.device, small: bool) -> None:
        self.device = device
        self.frames, self.height, self.width = (41, 32, 48) if small else (400, 250, 400)
        self.side, self.channels = (32, 8) if small else (384, 64)

    def rand(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=torch.Generator().manual_seed(0)).to(self.device)

    def light(self, frames: int) -> Tensor:
        scene = torch.linspace(0.02, 0.9, self.width, device=self.device)
        return scene * (0.9 + 0.2 * self.rand(frames, self.height, self.width))

    def spikes(self, frames: int) -> Tensor:
        light = self.light(frames)
        return (light.cumsum(0).floor() > (light.cumsum(0) - light).floor()).to(torch.uint8)

    def flow(self) -> Tensor:
        coarse = 8 * self.rand(1, 2, 5, 5) - 4
        return F.interpolate(coarse, size=(self.side, self.side), mode="bicubic", align_corners=True)


# --- alternatives in plain torch --------------------------------------------------------------------------------------


def unpack(packed: Tensor) -> Tensor:
    return (packed[..., None] >> torch.arange(8, dtype=torch.uint8, device=packed.device) & 1).flatten(-2)


def pack(spikes: Tensor) -> Tensor:
    bits = spikes.unflatten(-1, (-1, 8)) << torch.arange(8, dtype=torch.uint8, device=spikes.device)
    return bits.sum(-1, dtype=torch.uint8)


def intervals(spikes: Tensor) -> Tensor:
    """Compute eq. (4) in two passes, correct between two spikes."""
    last, before, after = torch.full(spikes.shape[1:], -1, device=spikes.device), [], []
    for n, frame in enumerate(spikes):
        before.append(last)
        last = torch.where(frame != 0, n, last)
    following = torch.full_like(last, len(spikes))
    for n in reversed(range(len(spikes))):
        following = torch.where(spikes[n] != 0, n, following)
        after.append(following)
    return torch.stack(after[::-1]) - torch.stack(before)


def means(spikes: Tensor, window: int) -> Tensor:
    half = window // 2
    return torch.stack(
        [spikes[max(n - half, 0) : n + half + 1].mean(0, dtype=torch.float32) for n in range(len(spikes))]
    )


def integrate_fire(light: Tensor) -> Tensor:
    charge, spikes = torch.zeros_like(light[0]), []
    for light_t in light:
        charge = charge + light_t
        spikes.append((charge >= 1).to(light.dtype))
        charge = charge - spikes[-1]
    return torch.stack(spikes)


def grid_sample(image: Tensor, flow: Tensor) -> Tensor:
    height, width = image.shape[-2:]
    y, x = torch.meshgrid(
        torch.arange(height, device=flow.device), torch.arange(width, device=flow.device), indexing="ij"
    )
    grid = torch.stack([2 * (x + flow[:, 0]) / (width - 1) - 1, 2 * (y + flow[:, 1]) / (height - 1) - 1], dim=-1)
    return F.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=True)


def colours(raw: Tensor) -> Tensor:
    planes = torch.zeros(3, *raw.shape, dtype=raw.dtype, device=raw.device)
    for colour, row, column in ((0, 0, 0), (1, 0, 1), (1, 1, 0), (2, 1, 1)):
        planes[colour, ..., row::2, column::2] = raw[..., row::2, column::2]
    return planes


def larger(flow: Tensor, scale: int) -> Tensor:
    return scale * F.interpolate(flow, scale_factor=scale, mode="bilinear", align_corners=False)


def motion(to_first: Tensor, to_last: Tensor, times: list[int], scale: int) -> Tensor:
    middle = (times[0] + times[-1]) / 2
    ends = ((to_first, times[0]) if t < middle else (to_last, times[-1]) for t in times)
    return torch.stack(
        [larger(flow * ((t - middle) / (end - middle)), scale) for t, (flow, end) in zip(times, ends, strict=True)], 1
    )


# --- alternatives of other projects, if installed ---------------------------------------------------------------------


def spikingjelly(light: Tensor) -> Run:
    with redirect_stdout(StringIO()):
        from spikingjelly.activation_based import neuron, surrogate
    fire = neuron.IFNode(1.0, None, surrogate.ATan(), detach_reset=True, step_mode="m").to(light.device)
    return lambda: (fire.reset(), fire(light))[1]


def spikezoo(spikes: Tensor) -> Run:
    with redirect_stdout(StringIO()):
        from spikezoo.archs.tfi.nets import TFIModel
    model, clip = TFIModel(len(spikes)), spikes.float()[None]
    model.device = clip.device
    return lambda: model(clip)[0, 0]


def scikit_image(one: Tensor, other: Tensor) -> Run:
    from skimage.metrics import structural_similarity

    pictures = [rgb.permute(1, 2, 0).cpu().numpy() for rgb in (one, other)]
    return lambda: torch.tensor(structural_similarity(*pictures, channel_axis=2, data_range=1.0))


def made(make: Callable[..., Run], *inputs: Tensor) -> dict[str, Run]:
    """Run a function if its project is installed."""
    try:
        return {make.__name__.replace("_", "-"): make(*inputs)}
    except ImportError:
        return {}


# --- rows ------------------------------------------------------------------------------------------------------------


def streams(given: Inputs) -> Iterator[Case]:
    spikes, plain = given.spikes(given.frames), "plain torch"
    bits = "uint8 " + "x".join(map(str, spikes.shape))
    packed = sk.pack_spikes(spikes)
    yield "pack_spikes", bits, lambda: sk.pack_spikes(spikes), {plain: lambda: pack(spikes)}
    yield "unpack_spikes", bits, lambda: sk.unpack_spikes(packed, given.width), {plain: lambda: unpack(packed)}
    yield "spike_interval", bits, lambda: sk.spike_interval(spikes), {plain: lambda: intervals(spikes)}
    yield "tfi", bits, lambda: sk.tfi(spikes), {plain: lambda: 1 / intervals(spikes)}
    for window in (11, 41):
        run = partial(sk.tfp, spikes, window)
        yield "tfp", f"{bits}, window {window}", run, {plain: partial(means, spikes, window)}
    clip = spikes[:41]
    yield "tfi_at", "frame 20 of 41", lambda: sk.tfi_at(clip, 20), made(spikezoo, clip)
    middle = {plain: lambda: clip.mean(0, dtype=torch.float32)}
    yield "tfp_at", "frame 20 of 41, window 41", lambda: sk.tfp_at(clip, 20, 41), middle
    light = given.light(given.frames)
    others = {plain: lambda: integrate_fire(light), **made(spikingjelly, light)}
    yield "spike_integrate_fire", "float32", lambda: sk.spike_integrate_fire(light)[0], others


def warps(given: Inputs) -> Iterator[Case]:
    flow, image = given.flow(), given.rand(1, given.channels, given.side, given.side)
    size = "x".join(map(str, image.shape))
    yield "flow_warp", size, lambda: sk.flow_warp(image, flow), {"grid_sample": lambda: grid_sample(image, flow)}
    red, green, _ = sk.bayer_mask(given.side // 2, given.side // 2, scale=2, device=given.device)
    for colour, mask in (("R", red), ("G", green)):
        run = partial(sk.flow_warp_idw, image, flow, mask)
        yield (
            "flow_warp_idw",
            f"{colour}, {size}",
            run,
            {"grid_sample, from all pixels": lambda: grid_sample(image, flow)},
        )

        def backward(warp: Callable[..., Tensor], *masks: Tensor) -> list[Tensor]:
            leaves = [image.detach().requires_grad_(), flow.detach().requires_grad_()]
            result = warp(*leaves, *masks)
            return [result.detach(), *torch.autograd.grad(result, leaves, image)]

        run = partial(backward, sk.flow_warp_idw, mask)
        others = {"grid_sample, from all pixels": partial(backward, grid_sample)}
        yield "flow_warp_idw", f"{colour}, {size}, forward and backward", run, others
    times = list(range(5, 36, 3))
    run = partial(sk.linear_motion, flow, -flow, times, scale=2)
    yield "linear_motion", "11 times, scale 2", run, {"interpolate": partial(motion, flow, -flow, times, 2)}
    yield "upsample_flow", "scale 4", lambda: sk.upsample_flow(flow, 4), {"interpolate": lambda: larger(flow, 4)}


def colour(given: Inputs) -> Iterator[Case]:
    rgb, fine = (given.rand(8, 3, s * given.height, s * given.width) for s in (1, 2))
    raw, clip = given.rand(8, given.height, given.width), given.spikes(41)
    yield "mosaic", "8 pictures", lambda: sk.mosaic(rgb), {"kornia": lambda: rgb_to_raw(rgb, CFA.BG)[:, 0]}
    others = {"avg_pool2d, kornia": lambda: rgb_to_raw(F.avg_pool2d(fine, 2), CFA.BG)[:, 0]}
    yield "bin_to_sensor", "8 pictures, scale 2", lambda: sk.bin_to_sensor(fine, scale=2), others
    yield "split_colors", "uint8, 41 frames", lambda: sk.split_colors(clip), {"plain torch": lambda: colours(clip)}
    others = {"kornia, bilinear": lambda: raw_to_rgb(raw[:, None], CFA.BG)}
    yield "demosaic", "8 pictures", lambda: sk.demosaic(raw), others
    binomial = torch.tensor([[0.25, 0.5, 0.25]], device=given.device)
    others = {"kornia": lambda: filter2d_separable(rgb, binomial, binomial)}
    yield "separable_filter", "8 pictures, 3 x 3", lambda: separable_filter(rgb, (0.25, 0.5, 0.25)), others
    yield "ssim", "1 picture", lambda: sk.ssim(rgb[0], rgb[1]), made(scikit_image, rgb[0], rgb[1])


def equal(ours: Any, theirs: Any) -> str:
    """Return the share of equal values, which other algorithms need not reach."""
    if not isinstance(ours, Tensor) or not isinstance(theirs, Tensor) or ours.shape != theirs.shape:
        return ""
    return f"{torch.isclose(ours.double(), theirs.double(), rtol=1e-3, atol=1e-3).double().mean().item():.1%}"


def measure(case: Case, rounds: int, timer: Any) -> Iterator[list[str]]:
    operator, name, ours, others = case
    times = interleave({"": ours, **others}, rounds, timer, seconds=2.0)
    for other, run in others.items():
        took = [f"{1e3 * statistics.median(times[side]):.3g}" for side in ("", other)]
        ratios = [f"{value:.3g}" for value in ratio(times[other], times[""])]
        yield [operator, name, other, *took, *ratios, equal(ours(), run())]


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("operators", nargs="*", metavar="OPERATOR", help="operators to measure; default: all")
    parser.add_argument("--device", default="cpu", help="cpu (one thread) or cuda; default: cpu")
    parser.add_argument("--rounds", type=int, default=7, help="timings of each side; default: 7")
    parser.add_argument("--small", action="store_true", help="small inputs, for a quick test")
    parser.add_argument(
        "-o", "--output", type=Path, default=ROOT / "results" / "operators.csv", help="default %(default)s"
    )
    asked = parser.parse_args(arguments)
    torch.set_num_threads(1)
    device = torch.device(asked.device)
    timer, unit = timer_of(device, 1)
    print(f"{torch.cuda.get_device_name() if device.type == 'cuda' else cpu_name()}; {software()}; {unit}")
    given, rows = Inputs(device, asked.small), []
    for case in (case for family in (streams, warps, colour) for case in family(given)):
        if not asked.operators or case[0] in asked.operators:
            for row in measure(case, asked.rounds, timer):
                rows.append(row)
                print(" | ".join(row), flush=True)
    before = []
    if asked.operators and asked.output.exists():  # keep the rows of other operators
        with asked.output.open(newline="") as file:
            before = [row for row in list(csv.reader(file))[1:] if row[0] not in asked.operators]
    with asked.output.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([HEADING, *before, *rows])


if __name__ == "__main__":
    main()

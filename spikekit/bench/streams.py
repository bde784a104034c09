"""The cases of the operators on spike streams: files, sensor, decoders."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor

from spikekit.bench import peers, plain
from spikekit.bench.case import SEED, Case, Other, Setup, other, sizes
from spikekit.decoders.dense import spike_interval, tfi, tfp
from spikekit.decoders.packing import pack_spikes, unpack_spikes
from spikekit.decoders.single_frame import tfi_at, tfp_at
from spikekit.io.files import read_spikes, write_spikes
from spikekit.sensor.integrate_fire import spike_integrate_fire


def _enclosed(spikes: Tensor) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Keep the frames that a spike precedes and a spike follows."""
    fired = (spikes != 0).to(torch.int16)
    before = (fired.cumsum(0) - fired) > 0
    after = fired.flip(0).cumsum(0).flip(0) > 0
    both = before & after
    return lambda ours, theirs: (ours[both], theirs[both])


def _read_spikes(setup: Setup) -> Iterator[Case]:
    if setup.device.type != "cpu":
        return  # files are read and written by the CPU
    size, spikes = setup.size, setup.spikes(setup.size.frames)
    path = setup.folder / "clip.dat"
    write_spikes(path, spikes, flip=True)
    others = [
        other("plain torch", plain.read_dat),
        Other("spikezoo, Python", partial(peers.spikezoo_load, version="python"), note="gives float32"),
        Other("spikezoo, C++", partial(peers.spikezoo_load, version="cpp"), note="gives float32"),
    ]
    inputs, read = (str(path), size.height, size.width), spikes.nbytes / 8
    yield Case(f".dat -> uint8 {sizes(spikes)}", partial(read_spikes, flip=True), inputs, others, read=read)


def _write_spikes(setup: Setup) -> Iterator[Case]:
    if setup.device.type != "cpu":
        return
    spikes = setup.spikes(setup.size.frames)
    ours, theirs = setup.folder / "ours.dat", setup.folder / "other.dat"

    def pair(_ours: Any, _theirs: Any) -> tuple[Tensor, Tensor]:
        return tuple(torch.frombuffer(bytearray(path.read_bytes()), dtype=torch.uint8) for path in (ours, theirs))

    others = [
        other("plain torch", partial(plain.write_dat, str(theirs)), pair),
        Other("spikezoo", partial(peers.spikezoo_save, str(theirs)), pair),
    ]
    work = {"pixels": spikes.numel(), "written": spikes.nbytes / 8}
    yield Case(f"uint8 {sizes(spikes)} -> .dat", partial(write_spikes, ours, flip=True), (spikes,), others, **work)


def _pack_spikes(setup: Setup) -> Iterator[Case]:
    spikes = setup.spikes(setup.size.frames)
    others = [other("plain torch", plain.pack)]
    yield Case(f"uint8 {sizes(spikes)} -> bits", pack_spikes, (spikes,), others, pixels=spikes.numel())


def _unpack_spikes(setup: Setup) -> Iterator[Case]:
    packed, width = pack_spikes(setup.spikes(setup.size.frames)), setup.size.width
    others = [other("plain torch", plain.unpack)]
    yield Case(f"bits {sizes(packed)} -> uint8", partial(unpack_spikes, width=width), (packed,), others)


def _spike_interval(setup: Setup) -> Iterator[Case]:
    spikes = setup.spikes(setup.size.frames)
    others = [other("plain torch", plain.intervals, _enclosed(spikes))]
    yield Case(f"uint8 {sizes(spikes)} -> int16", spike_interval, (spikes,), others)


def _tfi(setup: Setup) -> Iterator[Case]:
    spikes = setup.spikes(setup.size.frames)
    name, enclosed = f"uint8 {sizes(spikes)}", _enclosed(spikes)
    others = [other("plain torch", lambda spikes: 1 / plain.intervals(spikes), enclosed)]
    yield Case(f"{name} -> float32", tfi, (spikes,), others)
    picture = partial(tfi, max_range=255, dtype=torch.uint8)
    others = [other("plain torch", lambda spikes: (255 / plain.intervals(spikes)).round().to(torch.uint8), enclosed)]
    yield Case(f"{name} -> uint8 picture", picture, (spikes,), others)

    def forward_backward(spikes: Tensor, grad: Tensor) -> Tensor:
        leaf = spikes.detach().requires_grad_()
        return torch.autograd.grad(tfi(leaf), leaf, grad)[0]

    some = spikes[: setup.size.clip].float()
    work = {"read": 4 * some.nbytes, "written": 2 * some.nbytes}
    yield Case(f"float32 {sizes(some)}, forward + backward", forward_backward, (some, setup.rand(*some.shape)), **work)


def _tfi_at(setup: Setup) -> Iterator[Case]:
    clip = setup.spikes(setup.size.clip)
    middle = len(clip) // 2

    def enclosed(_: Tensor, theirs: Tensor, shift: int) -> tuple[Tensor, Tensor]:
        frame = middle + shift
        both = (clip[:frame].amax(0) & clip[frame:].amax(0)) != 0
        return tfi_at(clip, frame)[both], theirs[both]

    own = "from float32; its frame n is n + 1 of eq. (4), a spike at 0 counts as none"
    others = [
        other("plain torch", partial(plain.tfi_frame, n=middle), partial(enclosed, shift=0)),
        Other("spikezoo", peers.spikezoo_tfi, partial(enclosed, shift=1), note=own),
    ]
    yield Case(f"uint8 {sizes(clip)} -> float32, the middle frame", partial(tfi_at, frame=middle), (clip,), others)


def _tfp(setup: Setup) -> Iterator[Case]:
    spikes = setup.spikes(setup.size.frames)
    name = f"uint8 {sizes(spikes)}"
    for window in (11, 41):
        others = [other("plain torch", partial(plain.tfp, window=window))]
        yield Case(f"{name} -> float32, w = {window}", partial(tfp, window=window), (spikes,), others)

    def rounded(spikes: Tensor) -> Tensor:
        return (255 * plain.tfp(spikes, 11)).round().to(torch.uint8)

    picture = partial(tfp, window=11, max_range=255, dtype=torch.uint8)
    yield Case(f"{name} -> uint8 picture, w = 11", picture, (spikes,), [other("plain torch", rounded, tolerance=1)])


def _tfp_at(setup: Setup) -> Iterator[Case]:
    clip = setup.spikes(setup.size.clip)
    middle = len(clip) // 2
    for window, order in ((2 * middle + 1, 1), (2 * (middle // 3) + 1, 3)):
        name = f"uint8 {sizes(clip)} -> float32, the middle frame, w = {window}, order {order}"
        others = [other("plain torch", partial(plain.tfp_frame, n=middle, window=window, order=order))]
        yield Case(name, partial(tfp_at, frame=middle, window=window, order=order), (clip,), others)


def _spike_integrate_fire(setup: Setup) -> Iterator[Case]:
    light = setup.light(setup.size.frames)

    def first(ours: tuple[Tensor, Tensor], theirs: Tensor) -> tuple[Tensor, Tensor]:
        return ours[0], theirs

    others = [
        other("plain torch", plain.integrate_fire, first),
        Other("spikingjelly", peers.spikingjelly, first),
        Other("snntorch", peers.snntorch, first),
    ]
    yield Case(f"float32 {sizes(light)} -> float32, forward", spike_integrate_fire, (light,), others)
    charge = peers.spikezoo_charge(setup.size.height, setup.size.width, SEED).to(setup.device)
    in_bytes = partial(spike_integrate_fire, charge=charge, dtype=torch.uint8)
    others = [Other("spikezoo", partial(peers.spikezoo_simulate, seed=SEED), first, note="charge in float64")]
    yield Case(f"float32 {sizes(light)} -> uint8, forward", in_bytes, (light,), others)

    clip = light[: setup.size.clip].clone().requires_grad_()
    grad = setup.rand(*clip.shape)

    def with_gradient(run: Callable[[], Tensor]) -> Callable[[], tuple[Tensor, Tensor]]:
        def both() -> tuple[Tensor, Tensor]:
            spikes = run()
            return spikes, torch.autograd.grad(spikes, clip, grad)[0]

        return both

    def nth(n: int) -> Callable[[Any, Any], tuple[Tensor, Tensor]]:
        return lambda ours, theirs: (ours[n], theirs[n])

    own = "spikes compared; the gradient is its own"
    others = [
        Other("plain torch", lambda: with_gradient(partial(plain.integrate_fire, clip)), nth(1)),
        Other("spikingjelly", lambda: with_gradient(peers.spikingjelly(clip)), nth(0), note=own),
        Other("snntorch", lambda: with_gradient(peers.snntorch(clip)), nth(0), note=own),
    ]
    ours, work = (
        with_gradient(lambda: spike_integrate_fire(clip)[0]),
        {"read": 3 * clip.nbytes, "written": 2 * clip.nbytes},
    )
    yield Case(f"float32 {sizes(clip)}, forward + backward", ours, (), others, **work)


#: The cases of every operator, made one after the other so that only one set of inputs is in memory.
CASES = {
    "read_spikes": _read_spikes,
    "write_spikes": _write_spikes,
    "pack_spikes": _pack_spikes,
    "unpack_spikes": _unpack_spikes,
    "spike_interval": _spike_interval,
    "tfi": _tfi,
    "tfi_at": _tfi_at,
    "tfp": _tfp,
    "tfp_at": _tfp_at,
    "spike_integrate_fire": _spike_integrate_fire,
}

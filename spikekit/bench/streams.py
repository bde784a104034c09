"""The cases of the operators on spike streams: files, sensor, decoders."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor

from spikekit.bench import peers, plain
from spikekit.bench.case import SEED, Case, Other, Setup, floats, sizes
from spikekit.decoders.dense import spike_interval, tfi, tfp
from spikekit.decoders.packing import pack_spikes, unpack_spikes
from spikekit.decoders.single_frame import tfi_at, tfp_at
from spikekit.io.files import read_spikes, write_spikes
from spikekit.sensor.integrate_fire import spike_integrate_fire


def _enclosed(ours: Tensor, other: Tensor, spikes: Tensor) -> tuple[Tensor, Tensor]:
    """Keep the frames that a spike precedes and a spike follows."""
    fired = (spikes != 0).to(torch.int16)
    before = (fired.cumsum(0) - fired) > 0
    after = fired.flip(0).cumsum(0).flip(0) > 0
    both = before & after
    return ours[both], other[both]


def _read_spikes(setup: Setup) -> Iterator[Case]:
    if setup.device.type != "cpu":
        return  # files are read and written by the CPU
    size, spikes = setup.size, setup.spikes(setup.size.frames)
    path = setup.folder / "clip.dat"
    write_spikes(path, spikes, flip=True)
    shape = str(path), size.height, size.width
    yield Case(
        f".dat -> uint8 {sizes(spikes)}",
        lambda: read_spikes(*shape, flip=True),
        spikes.numel(),
        spikes.numel() / 8,
        spikes.numel(),
        [
            Other("plain torch", lambda: partial(plain.read_dat, *shape)),
            Other("spikezoo, Python", lambda: peers.spikezoo_load(*shape, "python"), note="gives float32"),
            Other("spikezoo, C++", lambda: peers.spikezoo_load(*shape, "cpp"), note="gives float32"),
        ],
    )


def _write_spikes(setup: Setup) -> Iterator[Case]:
    if setup.device.type != "cpu":
        return
    spikes = setup.spikes(setup.size.frames)
    ours, other = setup.folder / "ours.dat", setup.folder / "other.dat"

    def pair(_ours: Any, _other: Any) -> tuple[Tensor, Tensor]:
        return tuple(torch.frombuffer(bytearray(path.read_bytes()), dtype=torch.uint8) for path in (ours, other))

    yield Case(
        f"uint8 {sizes(spikes)} -> .dat",
        lambda: write_spikes(ours, spikes, flip=True),
        spikes.numel(),
        spikes.numel(),
        spikes.numel() / 8,
        [
            Other("plain torch", lambda: partial(plain.write_dat, str(other), spikes), pair),
            Other("spikezoo", lambda: peers.spikezoo_save(str(other), spikes), pair),
        ],
    )


def _pack_spikes(setup: Setup) -> Iterator[Case]:
    spikes = setup.spikes(setup.size.frames)
    yield Case(
        f"uint8 {sizes(spikes)} -> bits",
        lambda: pack_spikes(spikes),
        spikes.numel(),
        spikes.numel(),
        spikes.numel() / 8,
        [Other("plain torch", lambda: partial(plain.pack, spikes))],
    )


def _unpack_spikes(setup: Setup) -> Iterator[Case]:
    packed, width = pack_spikes(setup.spikes(setup.size.frames)), setup.size.width
    yield Case(
        f"bits {sizes(packed)} -> uint8",
        lambda: unpack_spikes(packed, width),
        8 * packed.numel(),
        packed.numel(),
        8 * packed.numel(),
        [Other("plain torch", lambda: partial(plain.unpack, packed))],
    )


def _spike_interval(setup: Setup) -> Iterator[Case]:
    spikes = setup.spikes(setup.size.frames)
    yield Case(
        f"uint8 {sizes(spikes)} -> int16",
        lambda: spike_interval(spikes),
        spikes.numel(),
        spikes.numel(),
        2 * spikes.numel(),
        [Other("plain torch", lambda: partial(plain.intervals, spikes), partial(_enclosed, spikes=spikes))],
    )


def _tfi(setup: Setup) -> Iterator[Case]:
    spikes = setup.spikes(setup.size.frames)
    enclosed = partial(_enclosed, spikes=spikes)
    yield Case(
        f"uint8 {sizes(spikes)} -> float32",
        lambda: tfi(spikes),
        spikes.numel(),
        spikes.numel(),
        4 * spikes.numel(),
        [Other("plain torch", lambda: lambda: 1 / plain.intervals(spikes), enclosed)],
    )
    yield Case(
        f"uint8 {sizes(spikes)} -> uint8 picture",
        lambda: tfi(spikes, 255, dtype=torch.uint8),
        spikes.numel(),
        spikes.numel(),
        spikes.numel(),
        [Other("plain torch", lambda: lambda: (255 / plain.intervals(spikes)).round().to(torch.uint8), enclosed)],
    )

    some = spikes[: setup.size.clip].float()
    grad = setup.rand(*some.shape)

    def forward_backward() -> tuple[Tensor, ...]:
        leaf = some.detach().requires_grad_()
        return torch.autograd.grad(tfi(leaf), leaf, grad)

    yield Case(f"float32 {sizes(some)}, forward + backward", forward_backward, some.numel(), *floats(some, 4, 2))


def _tfi_at(setup: Setup) -> Iterator[Case]:
    clip = setup.spikes(setup.size.clip)
    middle = len(clip) // 2

    def enclosed(_: Tensor, other: Tensor, shift: int) -> tuple[Tensor, Tensor]:
        frame = middle + shift
        both = (clip[:frame].amax(0) & clip[frame:].amax(0)) != 0
        return tfi_at(clip, frame)[both], other[both]

    yield Case(
        f"uint8 {sizes(clip)} -> float32, the middle frame",
        lambda: tfi_at(clip, middle),
        clip[0].numel(),
        clip.numel(),
        4 * clip[0].numel(),
        [
            Other("plain torch", lambda: partial(plain.tfi_frame, clip, middle), partial(enclosed, shift=0)),
            Other(
                "spikezoo",
                lambda: peers.spikezoo_tfi(clip),
                partial(enclosed, shift=1),
                note="from float32; its frame n is n + 1 of eq. (4), a spike at 0 counts as none",
            ),
        ],
    )


def _tfp(setup: Setup) -> Iterator[Case]:
    spikes = setup.spikes(setup.size.frames)
    for window in (11, 41):
        yield Case(
            f"uint8 {sizes(spikes)} -> float32, w = {window}",
            partial(tfp, spikes, window),
            spikes.numel(),
            spikes.numel(),
            4 * spikes.numel(),
            [Other("plain torch", lambda window=window: partial(plain.tfp, spikes, window))],
        )
    yield Case(
        f"uint8 {sizes(spikes)} -> uint8 picture, w = 11",
        lambda: tfp(spikes, 11, 255, dtype=torch.uint8),
        spikes.numel(),
        spikes.numel(),
        spikes.numel(),
        [Other("plain torch", lambda: lambda: (255 * plain.tfp(spikes, 11)).round().to(torch.uint8), tolerance=1)],
    )


def _tfp_at(setup: Setup) -> Iterator[Case]:
    clip = setup.spikes(setup.size.clip)
    middle = len(clip) // 2
    for window, order in ((2 * middle + 1, 1), (2 * (middle // 3) + 1, 3)):
        yield Case(
            f"uint8 {sizes(clip)} -> float32, the middle frame, w = {window}, order {order}",
            partial(tfp_at, clip, middle, window, order=order),
            clip[0].numel(),
            clip.numel(),
            4 * clip[0].numel(),
            [
                Other(
                    "plain torch",
                    lambda window=window, order=order: partial(plain.tfp_frame, clip, middle, window, order),
                )
            ],
        )


def _spike_integrate_fire(setup: Setup) -> Iterator[Case]:
    light = setup.light(setup.size.frames)

    def first(ours: tuple[Tensor, Tensor], other: Tensor) -> tuple[Tensor, Tensor]:
        return ours[0], other

    def others(light: Tensor) -> list[Other]:
        return [
            Other("plain torch", lambda: partial(plain.integrate_fire, light), first),
            Other("spikingjelly", lambda: peers.spikingjelly(light), first),
            Other("snntorch", lambda: peers.snntorch(light), first),
        ]

    yield Case(
        f"float32 {sizes(light)} -> float32, forward",
        lambda: spike_integrate_fire(light),
        light.numel(),
        *floats(light, 1, 1),
        others(light),
    )
    charge = peers.spikezoo_charge(setup.size.height, setup.size.width, SEED).to(setup.device)
    yield Case(
        f"float32 {sizes(light)} -> uint8, forward",
        lambda: spike_integrate_fire(light, charge=charge, dtype=torch.uint8),
        light.numel(),
        4 * light.numel(),
        light.numel(),
        [Other("spikezoo", lambda: peers.spikezoo_simulate(light, SEED), first, note="charge in float64")],
    )

    clip = light[: setup.size.clip].clone().requires_grad_()
    grad = setup.rand(*clip.shape)

    def with_gradient(run: Callable[[], Tensor]) -> Callable[[], tuple[Tensor, Tensor]]:
        def both() -> tuple[Tensor, Tensor]:
            spikes = run()
            return spikes, torch.autograd.grad(spikes, clip, grad)[0]

        return both

    def spikes_only(ours: Any, other: Any) -> tuple[Tensor, Tensor]:
        return ours[0], other[0]

    def gradient_only(ours: Any, other: Any) -> tuple[Tensor, Tensor]:
        return ours[1], other[1]

    own = "spikes compared; the gradient is its own"
    yield Case(
        f"float32 {sizes(clip)}, forward + backward",
        with_gradient(lambda: spike_integrate_fire(clip)[0]),
        clip.numel(),
        *floats(clip, 3, 2),
        [
            Other("plain torch", lambda: with_gradient(partial(plain.integrate_fire, clip)), gradient_only),
            Other("spikingjelly", lambda: with_gradient(peers.spikingjelly(clip)), spikes_only, note=own),
            Other("snntorch", lambda: with_gradient(peers.snntorch(clip)), spikes_only, note=own),
        ],
    )


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

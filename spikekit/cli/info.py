"""``spikekit info``: print statistics of a recording."""

from __future__ import annotations

import argparse

from torch import Tensor

from spikekit.cli import recordings
from spikekit.standard_output import say

#: Clocks per second of the cameras.
CLOCK_HZ = 20_000


def run(args: argparse.Namespace) -> None:
    """Print the size of a recording and the statistics of its spikes, in one pass over its frames."""
    recording = recordings.opened(args)
    frames, (height, width) = recording.frames, recording.size
    counts = recording.counts(0, frames)
    pixels, spikes = counts.numel(), int(counts.sum())
    rates = counts.double() / frames
    dead, full = int((counts == 0).sum()), int((counts == frames).sum())
    ending = args.file.suffix.lower()
    say(f"file         {args.file}")
    print(
        f"format       {ending}, {'8 pixels per byte, no header' if ending == '.dat' else 'an array of zeros and ones'}"
    )
    print(f"size         {height} x {width} (H x W), {args.file.stat().st_size} bytes")
    print(f"frames       {frames}, {1e3 * frames / CLOCK_HZ:g} ms at {CLOCK_HZ // 1000} kHz")
    print(f"bits set     {spikes} of {pixels * frames}, {spikes / (pixels * frames):.2%}")
    print(f"median       {rates.median():.4f} spikes per frame")
    print(f"darkest      {_at(rates, rates.argmin())}")
    print(f"brightest    {_at(rates, rates.argmax())}")
    print(f"never fire   {dead} of {pixels} pixels, {dead / pixels:.2%}")
    print(f"always fire  {full} of {pixels} pixels, {full / pixels:.2%}")
    if recording.calibration is not None:
        known = recording.calibration
        works = known.defects == 0
        gain = f"SD {known.gain[works].std():.2%}" if known.gain.ne(1).any() else "not measured"
        dark = f"{known.dark[works].mean():.2g} spikes per frame" if known.dark.any() else "not measured"
        print(f"calibration  gain {gain}, dark rate {dark}, {int((~works).sum())} defects")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    recordings.add_arguments(parser)


def _at(rates: Tensor, index: Tensor) -> str:
    row, column = divmod(int(index), rates.shape[-1])
    return f"{rates.flatten()[index]:.4f} spikes per frame, at row {row}, column {column}"

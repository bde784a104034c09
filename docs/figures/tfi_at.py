"""The spikes of a few pixels, and those that enclose one frame."""

import matplotlib.pyplot as plt
import torch

import spikekit as sk

frame, frames, pixels = 40, 81, 14
light = torch.linspace(0.75, 0.03, pixels).expand(frames, 1, pixels)
spikes = sk.simulate_spikes(light, generator=torch.Generator().manual_seed(3))
interval = sk.spike_interval_at(spikes, frame).flatten().tolist()
rate = sk.tfi_at(spikes, frame).flatten()

figure, (raster, bars) = plt.subplots(1, 2, figsize=(7.2, 3), sharey=True, layout="constrained", width_ratios=[4, 1])
for pixel in range(pixels):
    fired = spikes[:, 0, pixel].nonzero().flatten()
    before, after = fired[fired < frame][-1:], fired[fired >= frame][:1]
    raster.plot(fired, [pixel] * len(fired), "|", color="0.7")
    raster.plot([*before, *after], [pixel] * (len(before) + len(after)), "o-", markersize=3, color="tab:blue")
raster.axvline(frame, color="black", linestyle=":")
raster.set(xlabel="clock", ylabel="pixel", title=f"spikes; in blue, those that enclose frame {frame}")
bars.barh(range(pixels), rate, color="tab:blue")
bars.plot(light[0, 0], range(pixels), "k.")
bars.set(xlim=(0, 1.1), title="tfi_at, and light")
raster.invert_yaxis()

"""The interval that encloses every frame, for one pixel, and its substitute at the ends of the clip."""

import matplotlib.pyplot as plt
import torch

import spikekit as sk

spikes = torch.zeros(26, 1, 1)
spikes[[2, 7, 12, 14, 17]] = 1
interval = sk.spike_interval(spikes).flatten().int().tolist()
fired = spikes.flatten().nonzero().flatten().tolist()

figure, (top, bottom) = plt.subplots(2, 1, figsize=(7.2, 3.4), sharex=True, layout="constrained", height_ratios=[1, 3])
top.vlines(fired, 0, 1, color="tab:red", linewidth=2)
top.vlines([-1, 26], 0, 1, color="tab:red", linestyle=":")
top.text(-0.8, 0.5, "virtual", fontsize=8, va="center")
top.text(25.8, 0.5, "virtual", fontsize=8, va="center", ha="right")
top.set(yticks=[], ylabel="spikes")
complete = [fired[0] < n <= fired[-1] for n in range(26)]
colours = ["tab:blue" if inside else "0.7" for inside in complete]
bars = bottom.bar(range(26), interval, color=colours, width=0.8)
bottom.bar_label(bars, interval, fontsize=8)
bottom.set(xlabel="frame n", ylabel=r"interval $\Psi_n$", xlim=(-1.4, 26.4), ylim=(0, 13), xticks=range(0, 26, 2))
bottom.legend(
    handles=[bars[5], bars[0]],
    labels=["enclosed by two spikes", "one is missing: nearest interval, or that to the virtual spike if longer"],
    fontsize=8,
    loc="upper center",
)

"""One pixel: its light, its charge with the threshold, and its spikes."""

import matplotlib.pyplot as plt
import torch

import spikekit as sk

light = torch.tensor([0.15] * 12 + [0.43] * 12 + [1.27] * 6 + [-0.12] * 8 + [0.31] * 14)
clocks = range(len(light))
spikes, charges, charge = [], [0.0], None
for light_t in light.reshape(-1, 1, 1, 1):  # clock by clock, passing the charge on
    fired, charge = sk.spike_integrate_fire(light_t, charge=charge)
    spikes.append(fired.item())
    charges.append(charge.item())

figure, axes = plt.subplots(3, 1, figsize=(7.2, 4.6), sharex=True, layout="constrained", height_ratios=[2, 4, 1])
axes[0].step(clocks, light, where="mid", color="tab:orange")
axes[0].set_ylabel("light")
for t, added in enumerate(light.tolist()):
    reached = charges[t] + added
    axes[1].plot([t - 0.5, t + 0.5], [charges[t], reached], color="tab:blue")
    axes[1].plot([t + 0.5, t + 0.5], [reached, charges[t + 1]], color="tab:red", linestyle=":")
axes[1].axhline(1, color="black", linewidth=0.8)
axes[1].text(-0.3, 1.04, "threshold")
axes[1].text(26.5, 2.45, "two thresholds at once: one spike", ha="center", fontsize=9)
axes[1].text(38, -0.66, "a debt, paid back before the next spike", ha="center", fontsize=9)
axes[1].set(ylabel="charge", ylim=(-0.8, 2.8))
axes[2].bar(clocks, spikes, width=0.8, color="tab:red")
axes[2].set(ylabel="spikes", yticks=[], xlabel="clock", xlim=(-0.6, len(light) - 0.4))
for ax in axes[:2]:
    ax.axhline(0, color="0.8", linewidth=0.8)

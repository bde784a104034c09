"""One frame of a spike stream, and its three colours: full size, zero elsewhere."""

import matplotlib.pyplot as plt
import torch
from matplotlib.colors import ListedColormap

import spikekit as sk

ramp = torch.linspace(0.1, 1, 18).expand(12, 18)  # every colour grows to the right
spikes = sk.simulate_spikes(ramp[None].repeat(9, 1, 1), generator=torch.Generator().manual_seed(0))
frame = spikes[8]
known = sk.bayer_mask(*frame.shape, "RGGB")

figure, axes = plt.subplots(1, 4, figsize=(7.2, 1.7), layout="constrained")
axes[0].imshow(frame, cmap="gray")
axes[0].set_title("spikes")
for ax, colour, name, mask in zip(
    axes[1:], sk.split_colors(frame, "RGGB"), ("red", "green", "blue"), known, strict=True
):
    ax.imshow(colour + (mask == 0) * 2, cmap=ListedColormap(["black", name, "0.85"]), vmin=0, vmax=2)
    ax.set_title(name)
for ax in axes:
    ax.set(xticks=[], yticks=[])

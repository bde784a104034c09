"""TFI of one pixel under changing light, and of a picture at one frame."""

import math

import matplotlib.pyplot as plt
import torch
from skimage import data

import spikekit as sk

chance = torch.Generator().manual_seed(0)
clocks = torch.arange(240)
light = 0.25 + 0.2 * torch.sin(2 * math.pi * clocks / 160)
light[190:] = 0.6
pixel = sk.simulate_spikes(light.reshape(-1, 1, 1), generator=chance)

picture = torch.tensor(data.camera())[60:188, 180:308] / 255
still = sk.simulate_spikes(0.4 * picture.expand(41, -1, -1), generator=chance)

figure, axes = plt.subplot_mosaic(
    [["pixel", "pixel", "pixel"], ["truth", "spikes", "tfi"]],
    figsize=(7.2, 4.8),
    layout="constrained",
    height_ratios=[2, 3],
)
axes["pixel"].plot(clocks, light, color="black", label="light")
axes["pixel"].step(clocks, sk.tfi(pixel).flatten(), where="mid", color="tab:blue", label="tfi")
axes["pixel"].vlines(pixel.flatten().nonzero().flatten(), -0.12, -0.02, color="tab:red", linewidth=0.8)
axes["pixel"].text(0, -0.2, "spikes", color="tab:red", fontsize=8)
axes["pixel"].set(xlabel="clock", ylim=(-0.25, 1.1), title="one pixel")
axes["pixel"].legend(loc="upper left", ncols=2)
shown = {"truth": picture, "spikes": still[20], "tfi": sk.tfi(still)[20] / 0.4}
for name, values in shown.items():
    axes[name].imshow(values, cmap="gray", vmin=0, vmax=1)
    axes[name].set(xticks=[], yticks=[])
axes["truth"].set_title("scene")
axes["spikes"].set_title("spikes, frame 20 of 41")
axes["tfi"].set_title("tfi(spikes)[20] / 0.4")

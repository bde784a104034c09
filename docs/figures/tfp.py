"""TFP and TFI in motion: a short window is coarse, a long one is blurred, means of means are neither."""

import matplotlib.pyplot as plt
import torch
from skimage import data

import spikekit as sk

COLOURS = "black", "tab:blue", "tab:orange", "tab:green", "tab:red"
alpha, frames, size = 0.4, 81, 96
middle, row, column = frames // 2, 40, 60
page = torch.tensor(data.page())[:, :240].expand(3, -1, -1) / 255
scene = sk.Scene([sk.Layer(page, sk.Motion(velocity=(0.3, 0.0)), position=(-60, -20))], size, size, frames)
light = alpha * torch.stack([scene.rgb(clock)[1] for clock in range(frames)])
spikes = sk.simulate_spikes(light, generator=torch.Generator().manual_seed(0))
decoded = {
    "truth": light / alpha,
    "tfi": sk.tfi(spikes) / alpha,
    "tfp, 11": sk.tfp(spikes, 11) / alpha,
    "tfp, 41": sk.tfp(spikes, 41) / alpha,
    "tfp, 13, order=3": sk.tfp(spikes, 13, order=3) / alpha,
}

figure, axes = plt.subplot_mosaic(
    [list(decoded), ["pixel"] * 5], figsize=(8, 4.2), layout="constrained", height_ratios=[4, 3]
)
for (name, raw), colour in zip(decoded.items(), COLOURS, strict=True):
    axes[name].imshow(raw[middle], cmap="gray", vmin=0, vmax=1)
    axes[name].plot(column, row, "o", color="red", fillstyle="none")
    axes[name].set(title=name, xticks=[], yticks=[])
    axes["pixel"].plot(raw[:, row, column], label=name, color=colour, linewidth=2 if name == "truth" else 1.2)
axes["pixel"].set(xlabel="clock", xlim=(0, frames - 1), title="the marked pixel")
figure.legend(*axes["pixel"].get_legend_handles_labels(), ncols=5, loc="outside lower center", frameon=False)

"""One position among the known red pixels, its four neighbours with their weights, and a picture filled that way."""

import matplotlib.pyplot as plt
import torch
from skimage import data

import spikekit as sk

known = sk.bayer_mask(4, 4, "RGGB", scale=2)[0]  # red, after upsampling by 2
pixel, moved = (1, 2), (2.6, 3.2)  # (x, y), and where its flow leads
flow = torch.zeros(1, 2, 8, 8)
flow[0, :, pixel[1], pixel[0]] = torch.tensor(moved) - torch.tensor(pixel)
features = torch.zeros(1, 1, 8, 8, requires_grad=True)
result = sk.flow_warp_idw(features, flow, known)
result[0, 0, pixel[1], pixel[0]].backward()  # the gradient of a weighted mean is its weights
weights = features.grad[0, 0]

figure, axes = plt.subplots(1, 3, figsize=(7.2, 2.8), layout="constrained", width_ratios=[1.25, 1, 1])
axes[0].imshow(known, cmap="Reds", vmin=0, vmax=2)
axes[0].annotate("", moved, pixel, arrowprops={"arrowstyle": "->", "lw": 2})
axes[0].plot(*pixel, "ks", markersize=5)
for y, x in weights.nonzero().tolist():
    axes[0].plot([moved[0], x], [moved[1], y], color="0.5", linestyle=":", linewidth=1)
    axes[0].text(x, y, f"{weights[y, x]:.2f}", ha="center", va="center", fontsize=8, bbox={"fc": "white", "pad": 1})
axes[0].set(title="four nearest known pixels", xticks=range(8), yticks=range(8))
axes[0].tick_params(labelsize=7)

size = 48
image = torch.tensor(data.astronaut())[96 : 96 + size, 208 : 208 + size, 0][None, None] / 255
mask = sk.bayer_mask(size // 2, size // 2, "RGGB", scale=2)[0]
filled = sk.flow_warp_idw(image * mask, torch.zeros(1, 2, size, size), mask)
axes[1].imshow(torch.where(mask == 1, image, torch.nan)[0, 0], cmap="gray", vmin=0, vmax=1)
axes[1].set_facecolor("lightsteelblue")
axes[2].imshow(filled[0, 0], cmap="gray", vmin=0, vmax=1)
for ax, title in zip(axes[1:], ("known: one pixel in four", "flow_warp_idw, no flow"), strict=True):
    ax.set(title=title, xticks=[], yticks=[])

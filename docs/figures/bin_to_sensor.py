"""A picture on a sensor with four times coarser pixels: each averages its block, in its own colour."""

import matplotlib.pyplot as plt
import torch
from matplotlib.patches import Rectangle
from skimage import data

import spikekit as sk

scale, column, row = 4, 3, 2  # (3, 2) is a green pixel of RGGB
rgb = torch.tensor(data.coffee()).permute(2, 0, 1)[:, 176:200, 216:248] / 255
raw = sk.bin_to_sensor(rgb, "RGGB", scale=scale)
coloured = sk.split_colors(raw, "RGGB")

figure, axes = plt.subplots(1, 2, figsize=(7.2, 3.3), layout="constrained")
axes[0].imshow(rgb.permute(1, 2, 0))
axes[1].imshow(coloured.permute(1, 2, 0))
axes[0].set_title("rgb, with the sensor's pixels")
axes[1].set_title("raw, in its colours")
axes[0].set_xticks([scale * x - 0.5 for x in range(raw.shape[1])], minor=True)
axes[0].set_yticks([scale * y - 0.5 for y in range(raw.shape[0])], minor=True)
axes[0].grid(which="minor", color="white", linewidth=0.7)
axes[0].set(xticks=range(0, rgb.shape[2], scale), yticks=range(0, rgb.shape[1], scale))
axes[0].add_patch(Rectangle((scale * column - 0.5, scale * row - 0.5), scale, scale, fill=False, color="black", lw=2))
axes[1].add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, fill=False, color="white", lw=2))
block = rgb[1, scale * row : scale * (row + 1), scale * column : scale * (column + 1)]
axes[0].set_xlabel(f"green in the marked block: mean {block.mean():.3f}")
axes[1].set_xlabel(f"the marked pixel: {raw[row, column]:.3f}")

"""A picture, and its mosaic: one colour per pixel."""

import matplotlib.pyplot as plt
import torch
from skimage import data

import spikekit as sk

rgb = torch.tensor(data.astronaut()).permute(2, 0, 1)[:, 96:128, 208:256] / 255
raw = sk.mosaic(rgb, "RGGB")
coloured = sk.split_colors(raw, "RGGB")  # the same numbers, each in the plane of its colour

figure, axes = plt.subplots(1, 3, figsize=(7.2, 2.1), layout="constrained")
for ax, picture, title in zip(axes, (rgb, raw, coloured), ("rgb", "raw", "raw, in its colours"), strict=True):
    ax.imshow(picture if picture.ndim == 2 else picture.permute(1, 2, 0), cmap="gray", vmin=0, vmax=1)
    ax.set(title=title, xticks=[], yticks=[])

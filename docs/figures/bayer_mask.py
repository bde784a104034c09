"""The masks of the four Bayer phases, and the block that a known pixel becomes after upsampling."""

import matplotlib.pyplot as plt

import spikekit as sk

figure, axes = plt.subplots(2, 4, figsize=(7.2, 4), layout="constrained")
for ax, pattern in zip(axes[0], sk.PATTERNS, strict=True):
    mask = sk.bayer_mask(4, 4, pattern)
    ax.imshow(mask.permute(1, 2, 0), extent=(-0.5, 3.5, 3.5, -0.5))  # the three planes are the three colours
    for colour, row, column in sk.bayer_sites(pattern):
        ax.text(column, row, "RGB"[colour], ha="center", va="center", color="white", weight="bold")
    ax.set_title(f'"{pattern}"')
for ax, scale in zip(axes[1], (1, 2, 3, 4), strict=True):
    red = sk.bayer_mask(4, 4, "RGGB", scale=scale)[0]
    ax.imshow(red, cmap="Reds", vmin=-0.1, vmax=1.4)
    ax.set_title(f"red, scale={scale}")
for ax in axes.flat:
    height, width = ax.images[0].get_array().shape[:2]
    ax.set(xticks=[0, width - 1], yticks=[0, height - 1])
    ax.set_xticks([x + 0.5 for x in range(width - 1)], minor=True)
    ax.set_yticks([y + 0.5 for y in range(height - 1)], minor=True)
    ax.grid(which="minor", color="white", linewidth=0.8)
    ax.tick_params(which="minor", length=0)

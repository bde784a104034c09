"""A flow of three coarse pixels, and the same flow at three times the resolution."""

import matplotlib.pyplot as plt
import torch

import spikekit as sk

scale = 3
coarse = torch.tensor([[[0.1, 0.28, 0.28]], [[0.0, 0.0, 0.2]]])  # (2, 1, 3): x, then y
fine = sk.upsample_flow(coarse, scale)

figure, axes = plt.subplots(1, 2, figsize=(7.2, 1.8), layout="constrained")
titles = "flow, in its own pixels", f"upsample_flow(flow, {scale}), in its own"
for ax, flow, step, title in zip(axes, (coarse, fine), (1, scale), titles, strict=True):
    _, height, width = flow.shape
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    ax.plot(x.flatten(), y.flatten(), "k.", markersize=3)
    ax.quiver(x, y, *flow, angles="xy", scale_units="xy", scale=1, color="tab:blue", width=0.008)
    ax.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", title=title)
    ax.set(xticks=range(width), yticks=range(height))
    ax.set_xticks([i - 0.5 for i in range(0, width + 1, step)], minor=True)
    ax.grid(which="minor", color="0.8")  # around the coarse pixels

"""An image and a flow; every pixel of the result is sampled where its arrow points."""

import matplotlib.pyplot as plt
import torch
from skimage import data

import spikekit as sk

size = 96
image = torch.tensor(data.astronaut()).permute(2, 0, 1)[None, :, 64 : 64 + size, 176 : 176 + size] / 255
y, x = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
right = torch.tensor([20.0, 0.0]).reshape(2, 1, 1).expand(2, size, size)
swirl = torch.stack([48.0 - y, x - 48.0]) * 0.9 * torch.exp(-((x - 48) ** 2 + (y - 48) ** 2) / 900)

figure, axes = plt.subplots(1, 4, figsize=(7.2, 2.1), layout="constrained")
for (before, after), flow, step, title in (
    (axes[:2], right, 28, "flow = (20, 0)"),
    (axes[2:], swirl, 14, "flow: a swirl"),
):
    at = slice(6, None, 14), slice(6, None, step)
    before.imshow(image[0].permute(1, 2, 0), alpha=0.6)
    before.quiver(x[at], y[at], *flow[:, *at], angles="xy", scale_units="xy", scale=1, width=0.009)
    before.set(title=title, xlim=(-0.5, size - 0.5), ylim=(size - 0.5, -0.5))
    after.imshow(sk.flow_warp(image, flow[None])[0].permute(1, 2, 0))
    after.set_title("flow_warp")
for ax in axes:
    ax.set(xticks=[], yticks=[])

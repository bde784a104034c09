"""Four flows, one for each sub-stream of a Bayer cell, and their average at the centre of the cell."""

import matplotlib.pyplot as plt
import torch

import spikekit as sk

rows, columns = 2, 3
noise = torch.randn(4, 2, rows, columns, generator=torch.Generator().manual_seed(0))
flows = torch.tensor([0.3, 0.15]).reshape(1, 2, 1, 1) + 0.08 * noise  # in pixels of the sub-streams
joint = sk.joint_flow(flows)

figure, ax = plt.subplots(figsize=(6, 4.2), layout="constrained")
y, x = torch.meshgrid(2 * torch.arange(rows), 2 * torch.arange(columns), indexing="ij")


def arrows(flow, left, down, label, **style):
    """Draw a flow where its pixels lie on the sensor; a pixel of a sub-stream is two of the sensor wide."""
    ax.plot(x.flatten() + left, y.flatten() + down, ".", color=style["color"])
    ax.quiver(x + left, y + down, *(2 * flow), angles="xy", scale_units="xy", scale=1, label=label, **style)


names = {"R": "tab:red", "G1": "tab:green", "G2": "yellowgreen", "B": "tab:blue"}
for flow, (name, colour), (_, row, column) in zip(flows, names.items(), sk.bayer_sites("RGGB"), strict=True):
    arrows(flow, column, row, name, color=colour, width=0.005)
arrows(joint, 0.5, 0.5, "joint_flow", color="black", width=0.009)
ax.set_xticks([2 * i - 0.5 for i in range(columns + 1)], minor=True)
ax.set_yticks([2 * i - 0.5 for i in range(rows + 1)], minor=True)
ax.grid(which="minor", color="0.8")  # around the Bayer cells
ax.set(xticks=range(2 * columns), yticks=range(2 * rows), xlabel="x (sensor pixels)", ylabel="y")
ax.set(xlim=(-0.5, 2 * columns), ylim=(2 * rows - 0.2, -0.5), aspect="equal")
figure.legend(ncols=5, loc="outside upper center", frameon=False)

"""The colour wheel of flow: a flow has the colour of the point to which it leads from the centre."""

import matplotlib.pyplot as plt
import torch

import spikekit as sk

reach = 10
axis = torch.linspace(-reach, reach, 201)
v, u = torch.meshgrid(axis, axis, indexing="ij")
wheel = sk.flow_to_rgb(torch.stack([u, v]), max_flow=reach)
wheel = torch.where(torch.hypot(u, v) <= reach, wheel, 1)

figure, ax = plt.subplots(figsize=(3.6, 3.4), layout="constrained")
ax.imshow(wheel.permute(1, 2, 0), extent=(-reach, reach, reach, -reach))
for u, v, name in ((7, 0, "right"), (0, 7, "down"), (-7, 0, "left"), (0, -7, "up")):
    ax.annotate("", (u, v), (0, 0), arrowprops={"arrowstyle": "->"})
    ax.text(u * 1.15, v * 1.15, name, ha="center", va="center")
ax.set(xlabel="x flow (pixels)", ylabel="y flow")

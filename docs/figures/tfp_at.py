"""The weight of every frame of a clip in tfp_at: its gradient."""

import matplotlib.pyplot as plt
import torch

import spikekit as sk

frames = 41
clip = torch.zeros(frames, 1, 1, dtype=torch.float64, requires_grad=True)
figure, axes = plt.subplots(1, 2, figsize=(7.2, 3), sharey=True, layout="constrained")
for ax, frame in zip(axes, (20, 36), strict=True):
    for window, order in ((41, 1), (13, 1), (13, 2), (13, 3)):
        (weights,) = torch.autograd.grad(sk.tfp_at(clip, frame, window, order=order).sum(), clip)
        ax.step(range(frames), weights.flatten(), where="mid", label=f"window {window}, order {order}")
    ax.axvline(frame, color="black", linestyle=":")
    ax.set(xlabel="clock", xlim=(0, frames - 1), title=f"frame {frame}")
axes[0].set(ylabel="weight")
figure.legend(*axes[0].get_legend_handles_labels(), ncols=2, loc="outside lower center", frameon=False)

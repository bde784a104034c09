"""
Super-resolution by gradient descent
====================================

Without any weights, search for the picture that a model of the camera maps to the recorded data. All steps from the
picture to the sensor are differentiable, so Adam can optimise it.
"""

import matplotlib.pyplot as plt
import torch
from kornia.losses import total_variation
from skimage import data

import spikekit as sk
from lightning_modules.networks import ClassicalDecoder

scale, alpha, side = 2, 0.4, 128
photograph = torch.tensor(data.chelsea()).movedim(-1, 0)[:, 40:240, 120:320] / 255
scene = sk.Scene([sk.Layer(photograph, sk.Motion(velocity=(0.12, 0.07)), position=(-36, -36))], side, side)
spikes = sk.simulate_spikes(scene.light("RGGB", scale=scale, alpha=alpha), generator=torch.Generator().manual_seed(0))
truth = scene.rgb(scene.middle)

# %%
# The camera model moves the picture to every fifth clock along the flow and averages over the sensor's pixels. Its
# result should match the decoded spikes at those clocks. (This uses the true flow; an estimate works as well.)

clocks = list(range(5, 36, 5))
back = torch.stack([-scene.flow(clock, scale=1) for clock in clocks])  # from the clock to the middle
recorded = sk.tfp(spikes, 9, order=3)[clocks] / alpha


def camera(rgb):
    """Map a picture (3, H, W) to the mosaics at those clocks."""
    moved = sk.flow_warp(rgb.expand(len(clocks), -1, -1, -1), back)
    return sk.bin_to_sensor(moved, "RGGB", scale=scale)


def roughness(rgb):
    """Total variation of brightness, and twice that of the colours, which change more slowly."""
    grey = rgb.mean(dim=0, keepdim=True)
    return sum(weight * total_variation(part, reduction="mean").mean() for weight, part in ((1, grey), (2, rgb - grey)))


# %%
# Start from the classical decoder, and descend. Without the second term, the picture would fit the noise as well.

start = ClassicalDecoder("tfp", scale, "RGGB", alpha)(spikes[None])[0].clamp(0, 1)
rgb = start.clone().requires_grad_()
optimizer = torch.optim.Adam([rgb], lr=0.005)
course = []
for _ in range(40):
    loss = (camera(rgb) - recorded).square().mean() + 0.04 * roughness(rgb)
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    course.append(sk.psnr(rgb.detach().clamp(0, 1), truth).item())

figure, axes = plt.subplots(1, 4, figsize=(11, 2.9), layout="constrained", width_ratios=[1, 1, 1, 1.3])
shown = {"TFP, bicubic": start, "gradient descent": rgb.detach().clamp(0, 1), "truth": truth}
for ax, (name, picture) in zip(axes, shown.items(), strict=False):
    quality = "" if name == "truth" else f"\n{sk.psnr(picture, truth):.2f} dB"
    ax.imshow(picture.movedim(0, -1))
    ax.set_title(name + quality, fontsize=9)
    ax.set_axis_off()
axes[3].plot(course)
axes[3].set(xlabel="step", ylabel="PSNR (dB)")
axes[3].grid(alpha=0.3)

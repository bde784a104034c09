"""
TFI, TFP, and TFP of third order
================================

Three decoders without weights, on a scene that rests on the left and moves on the right.
"""

import matplotlib.pyplot as plt
import torch
from skimage import data

import spikekit as sk

alpha, half = 0.4, 96
picture = torch.tensor(data.astronaut()).movedim(-1, 0)[:, :256, 96:352] / 255


def clip(velocity):
    """Return spikes and ground truth of a picture that moves at ``velocity``, in sensor pixels per clock."""
    scene = sk.Scene([sk.Layer(picture, sk.Motion(velocity=velocity), position=(-60, -20))], 144, half)
    light = scene.light("RGGB", scale=1, alpha=alpha)
    return sk.simulate_spikes(light, generator=torch.Generator().manual_seed(0)), scene.rgb(scene.middle)


# %%
# TFI takes the inverse of the interval between two spikes: it follows motion, but its only values are 1, 1/2, 1/3, ...
# TFP counts spikes in a window: smooth at rest, blurred in motion. A mean of means of means (``order=3``) over 13
# frames each has much less rounding error than one mean, and the largest weight in the middle.

decoders = {
    "TFI": sk.tfi,
    "TFP, 41 frames": lambda spikes: sk.tfp(spikes, 41),
    "TFP, 13 frames, order 3": lambda spikes: sk.tfp(spikes, 13, order=3),
}
still, moving = clip((0.0, 0.0)), clip((0.25, 0.1))
figure, axes = plt.subplots(1, 4, figsize=(10, 2.8), layout="constrained")
axes[0].imshow(torch.cat([still[1], moving[1]], dim=-1).movedim(0, -1))
axes[0].set_title("truth: at rest | in motion")
for ax, (name, decode) in zip(axes[1:], decoders.items(), strict=True):
    shown = [sk.demosaic(decode(spikes)[20] / alpha, "RGGB").clamp(0, 1) for spikes, _ in (still, moving)]
    quality = [sk.psnr(rgb, truth).item() for rgb, (_, truth) in zip(shown, (still, moving), strict=True)]
    ax.imshow(torch.cat(shown, dim=-1).movedim(0, -1))
    ax.set_title(f"{name}\n{quality[0]:.1f} | {quality[1]:.1f} dB", fontsize=9)
for ax in axes:
    ax.axvline(half - 0.5, color="white", linewidth=1)
    ax.set_axis_off()

# %%
# The same as curves over the speed: TFP of third order is best up to a motion of several pixels within its window.

figure, ax = plt.subplots(figsize=(5.5, 3.2), layout="constrained")
speeds = [0.0, 0.05, 0.1, 0.2, 0.3, 0.4]
clips = [clip((speed, 0.0)) for speed in speeds]
for name, decode in decoders.items():
    pictures = [sk.demosaic(decode(spikes)[20] / alpha, "RGGB").clamp(0, 1) for spikes, _ in clips]
    ax.plot(speeds, [sk.psnr(rgb, clip[1]) for rgb, clip in zip(pictures, clips, strict=True)], "o-", label=name)
ax.set(xlabel="speed (sensor pixels per clock)", ylabel="PSNR (dB)")
ax.grid(alpha=0.3)
ax.legend()

"""
Spikes from a picture, and back
===============================

A picture becomes the light of a colour spike camera, the light becomes spikes, and TFP turns the spikes into a
picture again.
"""

import matplotlib.pyplot as plt
import torch
from skimage import data

import spikekit as sk

# %%
# The sensor is behind a Bayer filter, so every pixel sees one colour. ``light`` is the charge that a pixel collects in
# one clock, in thresholds; for a white pixel it is ``alpha``.

alpha = 0.4
rgb = torch.tensor(data.astronaut()).movedim(-1, 0)[:, :192, 128:320] / 255
raw = sk.mosaic(rgb, "RGGB")
light = alpha * raw.expand(41, -1, -1)  # 41 clocks of a scene at rest
spikes = sk.simulate_spikes(light, generator=torch.Generator().manual_seed(0))
print(tuple(spikes.shape), spikes.dtype, f"{spikes.float().mean():.3f} spikes per pixel and clock")

# %%
# To decode, count the spikes around the middle frame, divide by alpha, and interpolate the colours.

decoded = sk.tfp(spikes, 41)[20] / alpha
back = sk.demosaic(decoded, "RGGB").clamp(0, 1)

figure, axes = plt.subplots(1, 4, figsize=(9, 2.6), layout="constrained")
axes[0].imshow(rgb.movedim(0, -1))
axes[0].set_title("scene")
axes[1].imshow(raw, cmap="gray", vmin=0, vmax=1)
axes[1].set_title("mosaic")
axes[2].imshow(spikes[20], cmap="gray")
axes[2].set_title("spikes of one clock")
axes[3].imshow(back.movedim(0, -1))
axes[3].set_title(f"decoded: {sk.psnr(back, rgb):.1f} dB")
for ax in axes:
    ax.set_axis_off()

# %%
# How much does a longer window help? The remaining error is rounding: a window of W clocks resolves a rate to about 1 /
# W.

figure, ax = plt.subplots(figsize=(5, 3), layout="constrained")
windows = range(1, 42, 4)
quality = [sk.psnr((sk.tfp(spikes, window)[20] / alpha)[None].clamp(0, 1), raw[None]) for window in windows]
ax.plot(windows, quality, "o-")
ax.set(xlabel="window of TFP (clocks)", ylabel="PSNR of the mosaic (dB)")
ax.grid(alpha=0.3)

"""
Super-resolution with trained weights
=====================================

A clip of 41 frames becomes one picture at four times the resolution. The weights come with the package.
"""

import matplotlib.pyplot as plt
import torch
from skimage import data

import spikekit as sk
from lightning_modules.networks import CSCSR, ClassicalDecoder

scale, alpha = 4, 0.4
photograph = torch.tensor(data.astronaut()).movedim(-1, 0)[:, :320, 90:410] / 255
motion = sk.Motion(velocity=(0.3, 0.15), rotation=5e-4, center=(128.0, 128.0))
scene = sk.Scene([sk.Layer(photograph, motion, position=(-32, -16))], 256, 256)
light = scene.light("RGGB", scale=scale, alpha=alpha)
spikes = sk.simulate_spikes(light, generator=torch.Generator().manual_seed(0))[None]
truth = scene.rgb(scene.middle)
print("spikes", tuple(spikes.shape))

# %%
# The two decoders show what is possible without learning: spikes are decoded, demosaiced and upsampled bicubically.
# CSCSR estimates the motion from the spikes and searches along it for the pixels of every colour.

networks = {
    "TFI, bicubic": ClassicalDecoder("tfi", scale, "RGGB", alpha),
    "TFP, bicubic": ClassicalDecoder("tfp", scale, "RGGB", alpha),
    "cscsr_tiny_x4": CSCSR.from_pretrained("cscsr_tiny_x4"),
    "cscsr_huge_x4": CSCSR.from_pretrained("cscsr_huge_x4"),
}
with torch.no_grad():
    pictures = {name: network(spikes)[0].clamp(0, 1) for name, network in networks.items()}

figure, axes = plt.subplots(2, 5, figsize=(11, 4.7), layout="constrained")
for column, (name, rgb) in zip(axes.T, {**pictures, "truth": truth}.items(), strict=True):
    quality = "" if name == "truth" else f"\n{sk.psnr(rgb, truth):.2f} dB, SSIM {sk.ssim(rgb, truth):.3f}"
    column[0].imshow(rgb.movedim(0, -1))
    column[0].set_title(name + quality, fontsize=9)
    column[1].imshow(rgb[:, 60:140, 100:180].movedim(0, -1))
    for ax in column:
        ax.set_axis_off()

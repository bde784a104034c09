"""A picture, its mosaic, and the demosaiced picture."""

import matplotlib.pyplot as plt
import torch
from skimage import data

import spikekit as sk

rgb = torch.tensor(data.astronaut()).permute(2, 0, 1)[:, 64:160, 176:272] / 255
raw = sk.mosaic(rgb, "RGGB")
filled = sk.demosaic(raw, "RGGB")
error = (filled - rgb).abs().amax(0)

figure, axes = plt.subplots(1, 4, figsize=(7.2, 2.1), layout="constrained")
axes[0].imshow(rgb.permute(1, 2, 0))
axes[1].imshow(raw, cmap="gray", vmin=0, vmax=1)
axes[2].imshow(filled.clamp(0, 1).permute(1, 2, 0))
shown = axes[3].imshow(error, cmap="magma", vmin=0, vmax=0.3)
figure.colorbar(shown, ax=axes[3], shrink=0.75)
titles = "truth", "raw", f"demosaic, {sk.psnr(filled, rgb):.1f} dB", "largest error"
for ax, title in zip(axes, titles, strict=True):
    ax.set(title=title, xticks=[], yticks=[])

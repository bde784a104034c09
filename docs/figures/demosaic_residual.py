"""Residual interpolation of a mosaic, compared with linear filters."""

import matplotlib.pyplot as plt
import torch
from skimage import data

import spikekit as sk

rgb = torch.tensor(data.astronaut()).permute(2, 0, 1)[:, 64:160, 176:272] / 255
raw = sk.mosaic(rgb)
linear, residual = sk.demosaic(raw), sk.demosaic_residual(raw)

figure, axes = plt.subplots(1, 4, figsize=(7.2, 2.1), layout="constrained")
for ax, picture in zip(axes, (rgb, linear, residual), strict=False):
    ax.imshow(picture.clamp(0, 1).permute(1, 2, 0))
shown = axes[3].imshow((residual - rgb).abs().amax(0), cmap="magma", vmin=0, vmax=0.3)
figure.colorbar(shown, ax=axes[3], shrink=0.75)
titles = (
    "truth",
    f"demosaic, {sk.psnr(linear, rgb):.1f} dB",
    f"demosaic_residual,\n{sk.psnr(residual, rgb):.1f} dB",
    "largest error",
)
for ax, title in zip(axes, titles, strict=True):
    ax.set(xticks=[], yticks=[])
    ax.set_title(title, fontsize="small")

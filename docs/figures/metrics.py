"""Three degradations of equal PSNR and different SSIM."""

import matplotlib.pyplot as plt
import torch
import torch.nn.functional as F
from skimage import data

import spikekit as sk

truth = torch.tensor(data.astronaut()).permute(2, 0, 1)[:, 50:178, 160:288] / 255
noise = torch.randn(truth.shape, generator=torch.Generator().manual_seed(0))
blurred = F.avg_pool2d(F.pad(truth[None], (3, 3, 3, 3), "reflect"), 7, stride=1)[0]
size = (blurred - truth).square().mean().sqrt()
pictures = {
    "brighter": truth + size,
    "noisy": truth + size * noise,
    "blurred": blurred,
}

figure, axes = plt.subplots(1, 4, figsize=(7.2, 2.4), layout="constrained")
axes[0].imshow(truth.permute(1, 2, 0))
axes[0].set(title="truth")
for ax, (name, picture) in zip(axes[1:], pictures.items(), strict=True):
    ax.imshow(picture.clamp(0, 1).permute(1, 2, 0))
    ax.set(title=name, xlabel=f"psnr {sk.psnr(picture, truth):.1f} dB\nssim {sk.ssim(picture, truth):.3f}")
for ax in axes:
    ax.set(xticks=[], yticks=[])

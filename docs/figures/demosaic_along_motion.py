"""A moving photograph, decoded by TFI: demosaiced from one frame, and along its motion."""

import matplotlib.pyplot as plt
import torch
from skimage import data

import spikekit as sk
from spikekit.scenes.analytic import Layer, Motion, Scene

ALPHA, TIMES = 0.4, (10, 15, 20, 25, 30)
photograph = torch.tensor(data.astronaut()).permute(2, 0, 1)[:, 40:200, 150:310] / 255
scene = Scene([Layer(photograph, Motion((0.15, 0.075)), (-32, -32))], 96, 96)
spikes = sk.simulate_spikes(scene.light("RGGB", scale=1, alpha=ALPHA), generator=torch.Generator().manual_seed(0))
raw = torch.stack([sk.tfi_at(spikes, n) for n in TIMES]) / ALPHA
flow = torch.stack([scene.flow(n, scale=1) for n in TIMES])
truth, alone, along = scene.rgb(20), sk.demosaic_residual(raw[2]), sk.demosaic_along_motion(raw, flow)

figure, axes = plt.subplots(1, 3, figsize=(7.2, 2.7), layout="constrained")
titles = (
    "truth",
    f"demosaic_residual, {sk.psnr(alone, truth):.1f} dB",
    f"demosaic_along_motion, {sk.psnr(along, truth):.1f} dB",
)
for ax, picture, title in zip(axes, (truth, alone, along), titles, strict=True):
    ax.imshow(picture.clamp(0, 1).permute(1, 2, 0))
    ax.set(xticks=[], yticks=[])
    ax.set_title(title, fontsize="small")

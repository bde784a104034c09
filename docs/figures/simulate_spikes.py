"""A scene of two moving layers: its view, its true flow, and its spikes with and without photon noise."""

import matplotlib.pyplot as plt
import torch
from skimage import data

import spikekit as sk
from spikekit.sensor.noise import SensorNoise

background = sk.Layer(
    torch.tensor(data.chelsea()).permute(2, 0, 1)[:, :200, 100:330] / 255,
    sk.Motion(velocity=(0.3, 0.1)),
    position=(-30, -20),
)
y, x = torch.meshgrid(torch.arange(61) - 30, torch.arange(61) - 30, indexing="ij")
coin = sk.Layer(
    torch.tensor(data.astronaut()).permute(2, 0, 1)[:, 80:141, 190:251] / 255,
    sk.Motion(velocity=(-0.5, 0.3), rotation=0.02, center=(100.0, 70.0)),
    position=(70, 40),
    mask=((x**2 + y**2) < 28**2).float(),
)
scene = sk.Scene([background, coin], 144, 176)
light = scene.light("RGGB", scale=2, alpha=0.4)
flow = scene.flow(40, scale=2)
spikes = {
    photons: sk.simulate_spikes(light, noise=SensorNoise(photons=photons), generator=torch.Generator().manual_seed(0))
    for photons in (None, 10)
}

figure, axes = plt.subplots(2, 3, figsize=(7.2, 4.1), layout="constrained")
for ax, clock in zip(axes[0], (0, 20, 40), strict=True):
    ax.imshow(scene.rgb(clock).clamp(0, 1).permute(1, 2, 0))
    ax.set_title(f"scene.rgb({clock})")
axes[1, 0].imshow(sk.flow_to_rgb(flow).permute(1, 2, 0))
rows, columns = torch.meshgrid(torch.arange(4, 72, 8), torch.arange(4, 88, 8), indexing="ij")
axes[1, 0].quiver(columns, rows, *flow[:, rows, columns], angles="xy", scale_units="xy", scale=1, width=0.006)
axes[1, 0].set_title("scene.flow(40, scale=2)")
for ax, (photons, stream) in zip(axes[1, 1:], spikes.items(), strict=True):
    rgb = sk.demosaic(sk.tfi(stream)[20] / 0.4, "RGGB")
    ax.imshow(rgb.clamp(0, 1).permute(1, 2, 0))
    ax.set_title(f"photons={photons}")
for ax in axes.flat:
    ax.set(xticks=[], yticks=[])

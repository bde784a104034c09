"""
An ablation: the gain of motion
===============================

The same weights with four sources of motion: none, TV-L1 on decoded pictures, Spike2Flow on spike intervals, and the
true motion. ``lightning sweep`` trains and compares all ten variants of the paper; see :doc:`/howto/ablations`.
"""

import matplotlib.pyplot as plt
import torch
from skimage import data

import spikekit as sk
from lightning_modules.motion import ClassicalFlow, Spike2Flow, ZeroFlow
from lightning_modules.networks import CSCSR

scale, alpha = 4, 0.4
network = CSCSR.from_pretrained("cscsr_small_x4")
estimators = {
    "no motion": ZeroFlow(),
    "TV-L1": ClassicalFlow(),
    "Spike2Flow": Spike2Flow(weights="spike2flow"),
}
photographs = {"cat": data.chelsea()[20:300, 80:360], "astronaut": data.astronaut()[:280, 100:380]}
first, last = network.times[0], network.times[-1]

# %%
# Scenes with known flow: two photographs, at four speeds.

speeds = [0.0, 1.0, 2.0, 4.0]  # sensor pixels from the middle to the last time point
scores = {name: [] for name in [*estimators, "true motion"]}
for speed in speeds:
    found = {name: [] for name in scores}
    for photograph in photographs.values():
        picture = torch.tensor(photograph).movedim(-1, 0) / 255
        motion = sk.Motion(velocity=(0.9 * scale * speed / 15, 0.4 * scale * speed / 15))
        scene = sk.Scene([sk.Layer(picture, motion, position=(-44, -44))], 192, 192)
        light = scene.light("RGGB", scale=scale, alpha=alpha)
        spikes = sk.simulate_spikes(light, generator=torch.Generator().manual_seed(0))[None]
        truth = scene.rgb(scene.middle)
        flow = torch.stack([scene.flow(clock, scale=scale) for clock in (first, last)])[None]  # (1, 2, 2, H, W)
        with torch.no_grad():
            for name in scores:
                network.motion = estimators.get(name)
                rgb = network(spikes, flow if name == "true motion" else None)[0]
                found[name].append(sk.psnr(rgb.clamp(0, 1), truth).item())
    for name, values in found.items():
        scores[name].append(sum(values) / len(values))

figure, ax = plt.subplots(figsize=(6, 3.6), layout="constrained")
for name, values in scores.items():
    ax.plot(speeds, values, "o-" if name != "true motion" else "k:", label=name)
ax.set(xlabel="motion from the middle to the last time point (sensor pixels)", ylabel="PSNR (dB)")
ax.grid(alpha=0.3)
ax.legend()

# %%
# Without an estimate, moved pixels are searched for at the wrong place. At rest, all four agree. A little motion even
# helps: the sensor samples the scene between its pixels, and the search combines these samples.

for name, values in scores.items():
    print(f"{name:12}", "  ".join(f"{value:6.2f}" for value in values))

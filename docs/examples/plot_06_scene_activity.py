"""
Where motion is computed: scene activity
========================================

With ``lightning predict --tolerance`` a clip is analysed before the network runs. Parts at rest get no optical flow,
until the PSNR is expected to have fallen by so many dB. Here is what it decides.
"""

import matplotlib.pyplot as plt
import torch
from skimage import data

import spikekit as sk
from lightning_modules.inference.scene_activity import CELL, expected_errors, moving_cells, scene_activity
from lightning_modules.networks import CSCSR

scale, alpha, height, width = 4, 0.4, 128, 192
ground = torch.tensor(data.coffee()).movedim(-1, 0)[:, :400, :600] / 255
ground = torch.nn.functional.interpolate(ground[None], (scale * height, scale * width), mode="bicubic")[0].clamp(0, 1)
thing = torch.tensor(data.astronaut()).movedim(-1, 0)[:, 20:148, 160:288] / 255
y, x = torch.meshgrid(torch.linspace(-1, 1, 128), torch.linspace(-1, 1, 128), indexing="ij")
disc = (x**2 + y**2 <= 1).float()
moving = sk.Layer(thing, sk.Motion(velocity=(1.0, 0.5)), position=(480, 60), mask=disc)
scene = sk.Scene([sk.Layer(ground), moving], scale * height, scale * width)
light = scene.light("RGGB", scale=scale, alpha=alpha)
spikes = sk.simulate_spikes(light, generator=torch.Generator().manual_seed(0))[None]

# %%
# ``scene_activity`` measures every cell, ``expected_errors`` says what it would lose without motion, by an error model
# that was fitted for these weights, and ``moving_cells`` spends the tolerance on the cheapest cells first.

model = CSCSR.from_pretrained("cscsr_small_x4").error_model
still, error = expected_errors(scene_activity(spikes, "RGGB", alpha), model)
picture = sk.demosaic(sk.tfp(spikes[0], 13, order=3)[20] / alpha, "RGGB").clamp(0, 1)

figure, axes = plt.subplots(1, 3, figsize=(11, 2.9), layout="constrained")
for ax, tolerance in zip(axes, (0.02, 0.1, 0.5), strict=True):
    motion = moving_cells(still, error, tolerance)
    ax.imshow(picture.movedim(0, -1))
    overlay = torch.zeros(*motion.shape, 4)
    overlay[motion] = torch.tensor([0.3, 1.0, 0.2, 0.45])  # green: with optical flow
    ax.imshow(overlay, extent=(-0.5, width - 0.5, height - 0.5, -0.5), interpolation="nearest")
    ax.set_title(f"tolerance {tolerance} dB\n{motion.float().mean():.0%} with flow", fontsize=9)
    ax.set_xticks(range(0, width, CELL), [])
    ax.set_yticks(range(0, height, CELL), [])

# %%
# Green cells get optical flow; for the others the network takes the scene to be at rest. ``lightning predict`` then
# works tile by tile: a tile gets what its most demanding cell requires.

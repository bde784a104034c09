"""
A recording, decoded
====================

Read parts of a ``.dat`` file, decode single frames, and look at a column over time. The file is as cameras write it:
no header, eight pixels per byte, upside down. A simulated camera with noise writes it first; skip this if you have your
own.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from skimage import data

import spikekit as sk

height, width, frames, alpha = 120, 160, 400, 0.5
rocket = torch.tensor(data.rocket()).movedim(-1, 0)[:, 60:220, 220:480] / 255
motion = sk.Motion(velocity=(0.05, 0.15), rotation=5e-4, center=(80.0, 60.0))
scene = sk.Scene([sk.Layer(rocket, motion, position=(-50, -20))], height, width, frames)
noise = sk.SensorNoise(photons=500, dark_current=0.003, gain_spread=0.03)
generator = torch.Generator().manual_seed(0)
spikes = sk.simulate_spikes(scene.light("BGGR", scale=1, alpha=alpha), noise=noise, generator=generator)

folder = tempfile.TemporaryDirectory()
path = Path(folder.name, "rocket.dat")
sk.write_spikes(path, spikes, flip=True)
print(f"{path.name}: {path.stat().st_size:,} bytes for {frames} frames of {height} x {width}")

# %%
# Read 61 frames around the one of interest. :func:`~spikekit.tfi_at` and :func:`~spikekit.tfp_at` decode only that
# frame.

size = {"height": height, "width": width, "flip": True}
print(sk.spikes_shape(path, height, width))
figure, axes = plt.subplots(2, 3, figsize=(9, 5), layout="constrained")
for column, frame in zip(axes.T, (60, 200, 340), strict=True):
    part = sk.read_spikes(path, **size, start=frame - 30, frames=61)
    pictures = {"TFI": sk.tfi_at(part, 30), "TFP 13, order 3": sk.tfp_at(part, 30, 13, order=3)}
    for ax, (name, raw) in zip(column, pictures.items(), strict=True):
        ax.imshow(sk.demosaic(raw / alpha, "BGGR").clamp(0, 1).movedim(0, -1))
        ax.set_title(f"frame {frame}, {name}", fontsize=9)
        ax.set_axis_off()

# %%
# Read a recording that does not fit in memory in chunks. This shows the green pixels of a column over time, decoded
# piece by piece; the slopes are the motion.

chunks = sk.iter_spikes(path, **size, chunk=100)
pieces = sk.decode_in_chunks(lambda part: sk.tfp(part, 13, order=3), chunks, overlap=18)
column = torch.cat([piece[:, ::2, 51] for piece in pieces]) / alpha
figure, ax = plt.subplots(figsize=(9, 2.6), layout="constrained")
ax.imshow(column.T, cmap="gray", aspect="auto", interpolation="nearest", vmin=0, vmax=0.8)
ax.set(xlabel="frame", ylabel="row / 2", title="column 51 over time")
folder.cleanup()

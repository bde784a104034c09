"""
A film of a scene at rest
=========================

A disc moves in front of a photograph at rest. The film runs the network only where the spikes show motion; elsewhere it
keeps the picture and averages it. See :doc:`/howto/weights`, "Scenes at rest".
"""

import matplotlib.pyplot as plt
import torch
from skimage import data

import spikekit as sk
from lightning_modules.inference.film import FilmMaker
from lightning_modules.inference.rest import CELL
from lightning_modules.networks import CSCSR

scale, alpha, every, pictures = 4, 0.4, 20, 14
network = CSCSR.from_pretrained("cscsr_tiny_x4")

# %%
# The scene, and its spikes: 96 x 128 sensor pixels, a picture every 20 clocks.

behind, front = (torch.tensor(photograph).movedim(-1, 0) / 255 for photograph in (data.chelsea(), data.coffee()))
behind = torch.nn.functional.interpolate(behind[None], (400, 600), mode="bilinear")[0].clamp(0, 1)
front = front[:, 110:230, 240:360]
y, x = torch.meshgrid(torch.linspace(-1, 1, 120), torch.linspace(-1, 1, 120), indexing="ij")
disc = (y.square() + x.square() <= 1).to(front)
moving = sk.Layer(front, sk.Motion(velocity=(0.4, 0.1)), (120, 130), disc)
clocks = every * (pictures - 1) + network.frames
scene = sk.Scene([sk.Layer(behind), moving], 384, 512, clocks)
spikes = sk.simulate_spikes(scene.light("RGGB", scale=scale, alpha=alpha), generator=torch.Generator().manual_seed(0))

# %%
# The film, with a tolerance, and the share of cells of 8 x 8 sensor pixels that the network computed. The first ten
# pictures are computed everywhere: afterwards, the parts at rest show their mean.

film, shown, shares = FilmMaker(network, psnr_tolerance=0.1), [], []
for clock in range(network.frames // 2, clocks - network.frames // 2, every):
    clip = spikes[None, clock - network.frames // 2 :][:, : network.frames]
    rgb, computed = film(clip, [clock])[0], film.rest.computed
    shares.append(computed.float().mean().item())
    mask = computed.repeat_interleave(scale * CELL, 0).repeat_interleave(scale * CELL, 1)[:384, :512]
    shown.append((rgb, torch.stack([rgb[0], torch.where(mask, 0.6 * rgb[1] + 0.4, rgb[1]), rgb[2]])))

figure, axes = plt.subplots(1, 3, figsize=(9, 2.4), layout="constrained")
titles = {
    "last picture": shown[-1][0],
    "second; computed cells are green": shown[1][1],
    "last; computed cells are green": shown[-1][1],
}
for ax, (title, picture) in zip(axes, titles.items(), strict=True):
    ax.imshow(picture.movedim(0, -1))
    ax.set_title(title)
    ax.axis("off")

# %%
# The share falls as soon as the film knows what rests.

figure, ax = plt.subplots(figsize=(6, 2.4), layout="constrained")
ax.plot(range(1, pictures + 1), shares, "o-")
ax.set(xlabel="picture", ylabel="computed cells", ylim=(0, 1.05))
ax.grid(alpha=0.3)

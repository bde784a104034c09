"""Two rows of twelve pixels, and the bytes that hold them."""

import matplotlib.pyplot as plt
import torch

import spikekit as sk

spikes = (torch.rand(2, 12, generator=torch.Generator().manual_seed(5)) < 0.4).to(torch.uint8)
packed = sk.pack_spikes(spikes)

figure, ax = plt.subplots(figsize=(7.2, 2.5), layout="constrained")
shown = torch.full((2, 16), 0.5)  # the last four bits of a row are not pixels
shown[:, :12] = 1 - spikes.float()
ax.imshow(shown, cmap="gray", vmin=-0.4, vmax=1)
for y, x in torch.cartesian_prod(torch.arange(2), torch.arange(16)).tolist():
    bit = spikes[y, x] if x < 12 else 0
    ax.text(x, y, str(int(bit)), ha="center", va="center", color="white" if bit else "black")
    ax.text(x, -0.8, f"$2^{x % 8}$", ha="center", va="center", fontsize=9)
for y, x in torch.cartesian_prod(torch.arange(2), torch.arange(2)).tolist():
    ax.text(
        8 * x + 3.5, 1.95 + 0.5 * y, f"packed[{y}, {x}] = {packed[y, x]}", ha="center", va="center", family="monospace"
    )
ax.plot([7.5, 7.5], [-0.5, 1.5], color="tab:red", linewidth=3)
ax.axis("off")
ax.set(xlim=(-0.6, 15.6), ylim=(2.8, -1.2))

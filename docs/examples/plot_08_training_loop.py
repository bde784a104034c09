"""
Operators in your own training loop
===================================

Without Trainer or command line, the sensor is a layer like any other. The exposure of a scene and a small network
behind the sensor are trained together; the gradient of the exposure passes through the spikes.
"""

import matplotlib.pyplot as plt
import torch
from skimage import data
from torch import nn

import spikekit as sk


class Camera(nn.Module):
    """A gain for every colour, the sensor, and a network that restores the picture."""

    def __init__(self, clocks=21):
        super().__init__()
        self.clocks = clocks
        self.log_gain = nn.Parameter(torch.zeros(3, 1, 1))
        self.network = nn.Sequential(
            nn.Conv2d(3, 16, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(16, 16, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(16, 3, 3, padding=1),
        )

    def forward(self, rgb):
        """Map pictures (B, 3, H, W) to restored ones, by way of spikes."""
        light = sk.mosaic(rgb * self.log_gain.exp(), "RGGB")[:, None].expand(-1, self.clocks, -1, -1)
        start = torch.rand(light[:, 0].shape)  # initial charge
        spikes, _ = sk.spike_integrate_fire(light, charge=start)
        raw = sk.tfp(spikes, self.clocks)[:, self.clocks // 2]
        decoded = sk.demosaic(raw, "RGGB") / self.log_gain.exp()
        return decoded + self.network(decoded)


# %%
# The light is so bright and red that the sensor saturates: pixels collect more than one threshold per clock.

torch.manual_seed(0)
photograph = torch.tensor(data.astronaut()).movedim(-1, 0) / 255
scene = photograph * torch.tensor([3.0, 1.6, 0.8]).reshape(3, 1, 1)
model = Camera()
optimizer = torch.optim.Adam(
    [{"params": model.network.parameters(), "lr": 2e-3}, {"params": [model.log_gain], "lr": 3e-2}]
)
losses, gains = [], []
for _ in range(200):
    corners = torch.randint(0, 512 - 48, (4, 2)).tolist()
    batch = torch.stack([scene[:, y : y + 48, x : x + 48] for y, x in corners])
    loss = nn.functional.mse_loss(model(batch), batch)
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    losses.append(loss.item())
    gains.append(model.log_gain.detach().exp().flatten())

# %%
# The gradient of a spike count is that of the light, or 0 if the light is above the threshold. The loss therefore
# lowers the gains of red and green until the sensor no longer saturates, and raises that of the dark blue.

figure, axes = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
axes[0].semilogy(losses)
axes[0].set(xlabel="step", ylabel="mean square error")
for colour, gain in zip(("red", "green", "blue"), torch.stack(gains).T, strict=True):
    axes[1].plot(gain, color=f"tab:{colour}", label=colour)
axes[1].set(xlabel="step", ylabel="gain")
axes[1].legend()

# %%
# A part of the scene before and after, shown at the brightness of the photograph:

before = Camera()
part = scene[None, :, 20:180, 150:310]
light = torch.tensor([3.0, 1.6, 0.8]).reshape(3, 1, 1)
figure, axes = plt.subplots(1, 3, figsize=(9, 3.2), layout="constrained")
with torch.no_grad():
    shown = {"truth": part, "before": before(part), "after 200 steps": model(part)}
for ax, (name, rgb) in zip(axes, shown.items(), strict=True):
    ax.imshow((rgb[0] / light).clamp(0, 1).movedim(0, -1))
    ax.set_title(name)
    ax.set_axis_off()

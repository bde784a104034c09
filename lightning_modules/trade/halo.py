"""The halo of a network: how far it sees around a tile, measured, since it depends on the weights."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from lightning_modules.inference.tiles import BLEND, forward_in_tiles
from lightning_modules.networks import Network
from spikekit.scenes.analytic import Layer, Scene
from spikekit.sensor.simulate import simulate_spikes

#: what tiles may change in a picture: a hundredth of a step of 8 bits
BOUND = 0.01 / 255

_TILE = 64


@torch.no_grad()
def measure_halo(network: Network, start: int = 2 * BLEND) -> int:
    """Return the smallest halo with which tiles give what the whole picture gives, in float64, on a clip of noise.

    Args:
        network: a network that is run in tiles; it is left as it is.
        start: the smallest halo that is tried, even.

    Returns:
        The halo in sensor pixels, even.
    """
    network, spikes = copy.deepcopy(network).double(), _noise(network)
    whole = network(spikes, static=True)
    for halo in range(start, _TILE, 2):
        network.halo = halo
        if (forward_in_tiles(network, spikes, _TILE, static=True) - whole).abs().max() < BOUND:
            return halo
    return _TILE


def _noise(network: Network) -> Tensor:
    texture = torch.rand(3, _TILE, 2 * _TILE, generator=torch.Generator().manual_seed(0))
    view = texture.repeat_interleave(2, 1).repeat_interleave(2, 2)
    light = Scene([Layer(view)], *view.shape[1:], network.frames).light(
        network.pattern, scale=2, alpha=network.settings["alpha"]
    )
    return simulate_spikes(light, generator=torch.Generator().manual_seed(0))[None]

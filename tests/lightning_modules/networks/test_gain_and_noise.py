"""Gain and noise level of the camera as inputs of a network."""

from __future__ import annotations

import pytest
import torch

from lightning_modules.networks import CSCSR, RecurrentCSCSR
from lightning_modules.storage.pretrained import Weights, load_weights, read_weights, settings_of, write_weights

TINY = {"scale": 2, "width": 8, "representation_width": 8, "features": 1, "stages": 1, "end_blocks": 1}
TOLD = pytest.mark.parametrize("told", [{"noise": True}, {"noise": True, "noise_blocks": 1}])
KINDS = pytest.mark.parametrize("kind", [CSCSR, RecurrentCSCSR])


def _network(kind=CSCSR, **settings):
    torch.manual_seed(0)
    network = kind(**TINY, skip=True, **settings).eval()
    for name, parameter in network.named_parameters():  # initialised with 0
        if any(part in name for part in ("noise", "correction", "rgb")):
            parameter.data += 0.1 * torch.randn(parameter.shape)
    return network


def _spikes(*size):
    return (torch.rand(size, generator=torch.Generator().manual_seed(0)) < 0.4).float()


@KINDS
def test_picture_is_divided_by_the_gain(kind):
    network, spikes = _network(kind, alpha=0.5), _spikes(2, 41, 8, 10)
    picture = network(spikes, static=True)
    assert torch.equal(network(spikes, static=True, alpha=0.5), picture)
    torch.testing.assert_close(network(spikes, static=True, alpha=0.1), 5 * picture)
    each = network(spikes, static=True, alpha=torch.tensor([1.0, 0.05]))
    torch.testing.assert_close(each, picture * torch.tensor([0.5, 10.0]).reshape(2, 1, 1, 1))


@KINDS
@TOLD
@pytest.mark.parametrize("pattern", ["RGGB", "grey"])
def test_noise_level_is_set_per_clip(kind, told, pattern):
    network, spikes = _network(kind, **told, pattern=pattern), _spikes(2, 41, 8, 10)
    quiet, loud = (network(spikes, static=True, noise=level) for level in (0.0, 1.0))
    torch.testing.assert_close(network(spikes, static=True), quiet)
    assert not torch.allclose(quiet, loud, atol=1e-3)
    network.noise_level = 1.0
    torch.testing.assert_close(network(spikes, static=True), loud)
    each = network(spikes, static=True, noise=torch.tensor([0.0, 1.0]))
    torch.testing.assert_close(each, torch.stack([quiet[0], loud[1]]))


def test_gain_and_noise_are_set_per_film():
    network, films = _network(RecurrentCSCSR, noise=True), _spikes(2, 3, 41, 8, 10)
    told = {"noise": torch.tensor([0.3, 1.0]), "alpha": torch.tensor([0.2, 0.4])}
    both = network(films, static=True, future=2, **told)
    for n in range(2):
        one = {name: value[n].item() for name, value in told.items()}
        torch.testing.assert_close(network(films[n : n + 1], static=True, future=2, **one)[0], both[n])


@TOLD
def test_network_for_noisy_sensors_starts_from_weights_for_ideal_ones(told, tmp_path):
    old = _network()
    file = tmp_path / "ideal.safetensors"
    write_weights(Weights(file, settings_of(old), {}, old.state_dict()), file)
    new = CSCSR(**TINY, skip=True, **told)
    load_weights(new, read_weights(file))
    spikes = _spikes(1, 41, 8, 10)
    assert torch.equal(new(spikes, static=True, noise=1.0), old(spikes, static=True))


def test_invalid_gain_and_noise_are_rejected():
    with pytest.raises(ValueError, match="noise: expected None"):
        _network()(_spikes(1, 41, 8, 10), static=True, noise=0.5)
    with pytest.raises(ValueError, match=r"alpha: expected a number or shape \(2,\), got \(3,\)"):
        _network()(_spikes(2, 41, 8, 10), static=True, alpha=torch.ones(3))


@pytest.mark.parametrize("pattern", ["RGGB", "grey"])
def test_base_picture_is_not_rounded_to_bfloat16(pattern):
    network, spikes = CSCSR(**TINY, skip=True, pattern=pattern), _spikes(1, 41, 8, 10)  # untrained: the base alone
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        mixed = network(spikes, static=True)
    torch.testing.assert_close(mixed, network(spikes, static=True), rtol=0, atol=1e-6)

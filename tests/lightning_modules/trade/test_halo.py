import pytest
import torch

from lightning_modules.networks import CSCSR
from lightning_modules.storage.shipped import list_pretrained
from lightning_modules.trade import halo
from lightning_modules.trade.adaptive import main
from lightning_modules.trade.halo import measure_halo

# on one clip, a network for films is that of single clips, which is in the list
SHIPPED = [weights for weights in list_pretrained() if weights.scale and "_film_" not in weights.name]


@pytest.mark.parametrize("weights", SHIPPED, ids=lambda weights: weights.name)
def test_shipped_networks_see_no_further_than_their_halo(weights, monkeypatch):
    """In float32, whose roundings are a hundredth of the bound; the next test is of what the command does."""
    monkeypatch.setattr(torch.nn.Module, "double", torch.nn.Module.float)
    if weights.size.startswith(("large", "huge")):  # of which a smaller clip, too, shows a halo that is 2 too small
        monkeypatch.setattr(halo, "_TILE", 32)
    network = CSCSR.from_pretrained(weights.name)
    assert network.halo == weights.halo <= CSCSR.halo
    assert measure_halo(network, start=network.halo) == network.halo


def test_the_halo_of_weights_is_the_smallest_that_keeps_the_bound(capsys):
    main(["cscsr_tiny_x4", "--halo"])
    assert capsys.readouterr().out == f"cscsr_tiny_x4: {CSCSR.from_pretrained('cscsr_tiny_x4').halo}\n"

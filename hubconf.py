"""Entry points of ``torch.hub``: a network with each of the weights in the package, which needs no network.

``torch.hub.load(FOLDER, "cscsr_small_x4", source="local")`` from a clone; ``lightning models``
lists them. Arguments are those of ``CSCSR.from_pretrained``.
"""

from functools import partial

from lightning_modules.networks import CSCSR
from lightning_modules.registry import list_models

dependencies = ["torch", "kornia", "numpy", "safetensors"]


def _entry(name: str) -> partial[CSCSR]:
    load = partial(CSCSR.from_pretrained, name)
    load.__doc__ = f"Return CSCSR with the weights {name}, in evaluation mode, on the CPU."
    return load


globals().update({model.name: _entry(model.name) for model in list_models() if model.scale})

"""Entry points of ``torch.hub``, one for each network in the package; they work offline.

Use ``torch.hub.load(FOLDER, "cscsr_small_x4", source="local")`` in a clone. ``lightning models`` lists the names.
Arguments are those of ``CSCSR.from_pretrained``.
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

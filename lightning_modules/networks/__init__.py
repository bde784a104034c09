"""Networks as plain ``torch.nn``, usable without a Trainer."""

from lightning_modules.networks.classical import ClassicalDecoder
from lightning_modules.networks.cscsr import CSCSR
from lightning_modules.networks.network import Network

__all__ = ["CSCSR", "ClassicalDecoder", "Network"]

"""Methods to which the paper compares CSCSR (Table 2), implemented from their publications."""

from lightning_modules.networks.baselines.basicvsr import BasicVSR
from lightning_modules.networks.baselines.real_rawvsr import RealRawVSR
from lightning_modules.networks.baselines.spikesrnet import SpikeSRNetLike
from lightning_modules.networks.baselines.swinir import SwinIR
from lightning_modules.networks.baselines.tscnn import TSCNN
from lightning_modules.networks.baselines.vidarsr import VidarSR

__all__ = ["TSCNN", "BasicVSR", "RealRawVSR", "SpikeSRNetLike", "SwinIR", "VidarSR"]

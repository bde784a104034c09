"""Networks as plain ``torch.nn``, usable without a Trainer."""

from lightning_modules.networks.baselines import TSCNN, BasicVSR, RealRawVSR, SpikeSRNetLike, SwinIR, VidarSR
from lightning_modules.networks.classical import ClassicalDecoder
from lightning_modules.networks.cscsr import CSCSR
from lightning_modules.networks.cscsr_config import CSCSRConfig
from lightning_modules.networks.network import Network
from lightning_modules.networks.recurrent_cscsr import RecurrentCSCSR

#: networks by name, for weights and configurations
NETWORKS = {
    kind.__name__: kind
    for kind in (CSCSR, RecurrentCSCSR, ClassicalDecoder, BasicVSR, RealRawVSR, SpikeSRNetLike, SwinIR, TSCNN, VidarSR)
}

__all__ = [
    "CSCSR",
    "NETWORKS",
    "TSCNN",
    "BasicVSR",
    "CSCSRConfig",
    "ClassicalDecoder",
    "Network",
    "RealRawVSR",
    "RecurrentCSCSR",
    "SpikeSRNetLike",
    "SwinIR",
    "VidarSR",
]

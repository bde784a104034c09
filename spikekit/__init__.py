"""spikekit: differentiable operators for the colour spike camera."""

from spikekit import calibration, color, decoders, flow, io, scenes, sensor, warp
from spikekit._version import __version__ as __version__
from spikekit.calibration import *  # noqa: F403
from spikekit.color import *  # noqa: F403
from spikekit.decoders import *  # noqa: F403
from spikekit.flow import *  # noqa: F403
from spikekit.io import *  # noqa: F403
from spikekit.metrics import psnr, ssim
from spikekit.scenes import *  # noqa: F403
from spikekit.sensor import *  # noqa: F403
from spikekit.warp import *  # noqa: F403

__all__ = ["psnr", "ssim"]
__all__ += calibration.__all__
__all__ += color.__all__
__all__ += decoders.__all__
__all__ += flow.__all__
__all__ += io.__all__
__all__ += scenes.__all__
__all__ += sensor.__all__
__all__ += warp.__all__

"""Warping by optical flow, and demosaicing along motion."""

from spikekit.warp.motion_demosaic import DemosaicAlongMotion, demosaic_along_motion
from spikekit.warp.warp import FlowWarp, FlowWarpIdw, flow_warp, flow_warp_idw

__all__ = [
    "DemosaicAlongMotion",
    "FlowWarp",
    "FlowWarpIdw",
    "demosaic_along_motion",
    "flow_warp",
    "flow_warp_idw",
]

"""Motion fields, frame interpolation and optical flow."""

from spikekit.flow.fields import JointFlow, LinearMotion, UpsampleFlow, joint_flow, linear_motion, upsample_flow
from spikekit.flow.interpolate import Between, Blend, FlowInterpolation, Still

__all__ = [
    "Between",
    "Blend",
    "FlowInterpolation",
    "JointFlow",
    "LinearMotion",
    "Still",
    "UpsampleFlow",
    "joint_flow",
    "linear_motion",
    "upsample_flow",
]

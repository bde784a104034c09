"""Estimators of motion: from a clip of spikes to the flows from its middle to its first and last time point."""

from lightning_modules.motion.classical import ClassicalFlow
from lightning_modules.motion.estimator import MotionEstimator
from lightning_modules.motion.spike2flow import Spike2Flow
from lightning_modules.motion.zero import ZeroFlow

#: what weights and configurations may name
ESTIMATORS = {kind.__name__: kind for kind in (ClassicalFlow, Spike2Flow, ZeroFlow)}

__all__ = ["ESTIMATORS", "ClassicalFlow", "MotionEstimator", "Spike2Flow", "ZeroFlow"]

"""Estimators of motion: from a clip of spikes to the flows from its middle to its first and last time point."""

from lightning_modules.motion.classical import ClassicalFlow
from lightning_modules.motion.estimator import MotionEstimator
from lightning_modules.motion.spike2flow import Spike2Flow
from lightning_modules.motion.zero import ZeroFlow

__all__ = ["ClassicalFlow", "MotionEstimator", "Spike2Flow", "ZeroFlow"]

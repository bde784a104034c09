"""Motion estimators: flows from the middle of a clip to its first and last time points."""

from lightning_modules.motion.classical import ClassicalFlow
from lightning_modules.motion.estimator import MotionEstimator, ZeroFlow
from lightning_modules.motion.spike2flow import Spike2Flow

#: estimators by name, for weights and configurations
ESTIMATORS = {kind.__name__: kind for kind in (ClassicalFlow, Spike2Flow, ZeroFlow)}

__all__ = ["ESTIMATORS", "ClassicalFlow", "MotionEstimator", "Spike2Flow", "ZeroFlow"]

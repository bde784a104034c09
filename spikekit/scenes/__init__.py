"""Scenes: analytic scenes and sequences of frames."""

from spikekit.scenes.adaptive_sampling import Plan, SceneProfile
from spikekit.scenes.analytic import Layer, Motion, Scene
from spikekit.scenes.frame_sequence import FrameSequence, SequenceClip

__all__ = [
    "FrameSequence",
    "Layer",
    "Motion",
    "Plan",
    "Scene",
    "SceneProfile",
    "SequenceClip",
]

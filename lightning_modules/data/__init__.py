"""Clips to train on, to judge by, and to reconstruct."""

from lightning_modules.data.recording import Recording, RecordingClips
from lightning_modules.data.stills import StillClips, StillScenes

__all__ = ["Recording", "RecordingClips", "StillClips", "StillScenes"]

"""Clips for training, validation and tests."""

from lightning_modules.data.recording import RecordingScenes
from lightning_modules.data.sequences import FilmScenes, SequenceClips
from lightning_modules.data.stills import StillClips, StillScenes

__all__ = ["FilmScenes", "RecordingScenes", "SequenceClips", "StillClips", "StillScenes"]

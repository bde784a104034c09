"""Clips to train on, to judge by, and to reconstruct."""

from lightning_modules.data.sequences import FilmScenes, SequenceClips
from lightning_modules.data.stills import StillClips, StillScenes

__all__ = ["FilmScenes", "SequenceClips", "StillClips", "StillScenes"]

"""Clips to train on, to judge by, and to reconstruct."""

from lightning_modules.data.films import FilmClips, FilmScenes
from lightning_modules.data.stills import StillClips, StillScenes

__all__ = ["FilmClips", "FilmScenes", "StillClips", "StillScenes"]

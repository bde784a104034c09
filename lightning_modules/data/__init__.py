"""Clips to train on, to judge by, and to reconstruct."""

import lightning_modules.tasks  # noqa: F401 - before what imports Lightning, which it does in half the time
from lightning_modules.data.films import FilmClips, FilmScenes
from lightning_modules.data.recording import Recording, RecordingClips
from lightning_modules.data.stills import StillClips, StillScenes

__all__ = ["FilmClips", "FilmScenes", "Recording", "RecordingClips", "StillClips", "StillScenes"]

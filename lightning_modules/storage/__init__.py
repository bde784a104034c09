"""Weights, checkpoints and their settings in files; nothing in a file is run."""

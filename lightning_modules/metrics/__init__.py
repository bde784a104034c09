"""Metrics for pictures, films and optical flow."""

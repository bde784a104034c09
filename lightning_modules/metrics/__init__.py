"""Metrics of pictures and of optical flow."""

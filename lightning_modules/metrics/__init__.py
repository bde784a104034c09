"""Metrics of pictures, of films and of optical flow."""

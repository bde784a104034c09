"""Metrics for pictures and films."""

"""Measurement of cost and quality of settings, side by side: ``lightning trade``."""

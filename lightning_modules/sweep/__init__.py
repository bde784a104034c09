"""Training and test of every combination of overlays, values and seeds under one budget: ``lightning sweep``."""

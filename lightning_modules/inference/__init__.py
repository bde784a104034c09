"""Running a trained network: films, tiles, self-ensembles, presets."""

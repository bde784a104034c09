"""Running a trained network: tiles, scene activity, self-ensembles, presets."""

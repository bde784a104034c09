"""Cost and quality of settings, measured side by side; ``sweep`` and ``trade`` share it."""

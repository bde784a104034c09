"""``lightning sweep``: every combination of overlays, values and seeds, trained and tested under the same budget."""

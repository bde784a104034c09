"""``lightning trade``: cost and quality of every setting, measured side by side."""

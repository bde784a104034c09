"""``lightning trade``: what every setting costs and what it is worth, measured side by side."""

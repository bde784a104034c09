"""The ``lightning`` command."""

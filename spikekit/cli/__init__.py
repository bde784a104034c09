"""The ``spikekit`` command."""

"""Modules without doctests where what they need is missing; any other that cannot be imported is an error."""

from importlib.util import find_spec

collect_ignore_glob = [] if find_spec("triton") else ["spikekit/kernels/gpu*.py"]

"""``python -m spikekit`` is the ``spikekit`` command."""

import sys

from spikekit.cli.command import main

if __name__ == "__main__":
    sys.exit(main())

"""Starts the ``lightning`` command; ``python -m lightning_modules`` does the same."""

import os


def main() -> None:
    """Run :func:`lightning_modules.cli.main`."""
    # Threads of torch that spin while they wait hold up the workers that make clips: before torch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from lightning_modules.cli import main

    main()


if __name__ == "__main__":
    main()

"""Packages of the extra ``learn``, which the commands need and the operators do not."""

from __future__ import annotations

#: import names of the packages
LEARN = {
    "PIL",
    "filelock",
    "jsonargparse",
    "lightning_fabric",
    "matplotlib",
    "pytorch_lightning",
    "safetensors",
    "scipy",
    "skimage",
    "tabulate",
    "tensorboard",
    "tifffile",
    "tqdm",
    "yaml",
}


def remedy(error: ModuleNotFoundError) -> str | None:
    """Return a message for a user without the extra, or None if another package is missing.

    Example:
        >>> remedy(ModuleNotFoundError("No module named 'PIL'", name="PIL"))
        "expected the package PIL, which pip install 'spikekit[learn]' brings, got none"
    """
    package = (error.name or "").partition(".")[0]
    if package not in LEARN:
        return None
    return f"expected the package {package}, which pip install 'spikekit[learn]' brings, got none"

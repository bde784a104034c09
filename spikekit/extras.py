"""What the commands import and the operators do not: the packages of the extra ``learn``."""

from __future__ import annotations

#: by the names that are imported
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
    """Return the line for a user who lacks the extra, or None where something else is missing.

    Example:
        >>> remedy(ModuleNotFoundError("No module named 'PIL'", name="PIL"))
        "expected the package PIL, which pip install 'spikekit[learn]' brings, got none"
    """
    package = (error.name or "").partition(".")[0]
    if package not in LEARN:
        return None
    return f"expected the package {package}, which pip install 'spikekit[learn]' brings, got none"

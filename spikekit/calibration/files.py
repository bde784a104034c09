"""Calibration files: safetensors beside the recordings of a sensor."""

from __future__ import annotations

from pathlib import Path

from spikekit.arguments import home_path, one_line
from spikekit.calibration.calibration import Calibration
from spikekit.io.failures import no_pipe
from spikekit.io.images import MOST_PIXELS
from spikekit.io.whole_file import write_whole

#: Ending of a recording's own calibration file.
ENDING = ".calibration.safetensors"

_KIND = "spikekit calibration 1"
_PLANES = {"gain": "F32", "dark": "F32", "defects": "U8"}


def write_calibration(path: str | Path, calibration: Calibration) -> None:
    """Write a calibration atomically.

    Args:
        path: the file to write; its name ends in .safetensors.
        calibration: the calibration. The commands store its rows in the order of the recording, before any flip.

    Raises:
        ValueError: the name has another ending.
        OSError: the file cannot be written.

    Example:
        >>> import tempfile, torch
        >>> planes = torch.ones(4, 6), torch.zeros(4, 6), torch.zeros(4, 6, dtype=torch.uint8)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_calibration(f"{folder}/street.calibration.safetensors", Calibration(*planes))
        ...     read_calibration(f"{folder}/street.calibration.safetensors").size
        (4, 6)
    """
    if Path(path).suffix != ".safetensors":
        raise ValueError(f"{path}: expected a name that ends in .safetensors")
    from safetensors.torch import save

    planes = {name: getattr(calibration, name).contiguous() for name in _PLANES}
    write_whole(path, save(planes, {"kind": _KIND}))


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration. The file cannot run code.

    Args:
        path: a file written by :func:`write_calibration` or ``spikekit calibrate``.

    Returns:
        The calibration, with rows in the order of the file.

    Raises:
        ValueError: the file cannot be read, is damaged, or is not a valid calibration; the message is one line and
            names the file.

    Example:
        >>> read_calibration("street.calibration.safetensors")
        Traceback (most recent call last):
        ValueError: street.calibration.safetensors: not a readable calibration (No such file or directory...
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(no_pipe(home_path(path)), "pt") as file:
            kind = (file.metadata() or {}).get("kind")
            if kind != _KIND:
                raise ValueError(f"expected {_KIND}, got {str(kind)[:80]}")
            parts = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118
            stored = {name: (part.get_dtype(), tuple(part.get_shape())) for name, part in parts.items()}
            size = stored.get("gain", (None, ()))[1]
            if stored != {name: (dtype, size) for name, dtype in _PLANES.items()}:
                raise ValueError(f"expected gain, dark and defects of one size, got {str(stored)[:200]}")
            if len(size) != 2 or not 0 < size[0] * size[1] <= MOST_PIXELS:
                raise ValueError(f"expected (H, W) of at most {MOST_PIXELS} pixels, got {size}")
            return Calibration(**{name: file.get_tensor(name) for name in _PLANES})
    except (SafetensorError, OSError, ValueError) as error:
        raise ValueError(f"{path}: not a readable calibration ({one_line(error)[:300]})") from error

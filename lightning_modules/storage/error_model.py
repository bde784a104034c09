"""Error model of a network: the squared error that skipping work adds, with constants fitted for its weights."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from spikekit.arguments import one_line
from spikekit.io.whole_file import whole_file

#: the file, in the folder of the weights
FILE = "scene_activity.json"


@dataclass(frozen=True)
class ErrorModel:
    """Squared errors per squared statistic of a clip, all in units of a white pixel.

    ``python benchmarks/tolerance.py WEIGHTS --fit`` fits them, to the side that spends more. The defaults
    are the most careful of all weights of the package, for networks whose own were not measured.

    Args:
        still: added by a network that is told that nothing moves, per change.
        textured: left by the network itself, per texture.
        moved: likewise, per change.
        faint: likewise, everywhere.

    Raises:
        ValueError: a constant that is no finite number of 0 or more.
    """

    still: float = 0.18
    textured: float = 0.07
    moved: float = 0.0005
    faint: float = 9e-6

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= sys.float_info.max:
                raise ValueError(f"{name}: expected a finite number of 0 or more, got {value!r}")


def read_error_model(weights: str | Path) -> ErrorModel:
    """Return the constants of a file of weights, or the defaults where it has none, as a checkpoint has none.

    Raises:
        ValueError: a damaged file of constants; the message is one line and names it.
    """
    path = Path(weights)
    return _read(path.with_name(FILE)).get(path.name, ErrorModel()) if path.suffix == ".safetensors" else ErrorModel()


def write_error_model(weights: str | Path, model: ErrorModel) -> Path:
    """Write the constants of a file of safetensors beside it, and return the file, which holds those of the folder.

    Raises:
        ValueError: no file of safetensors, or a damaged file of constants.
    """
    path = Path(weights)
    if path.suffix != ".safetensors":
        raise ValueError(f"{path}: expected a file of safetensors, such as lightning export writes")
    models = {**_read(path.with_name(FILE)), path.name: model}
    content: dict[str, Any] = {name: asdict(models[name]) for name in sorted(models)}
    with whole_file(path.with_name(FILE), "w") as file:
        json.dump(content, file, indent=1)
        file.write("\n")
    return path.with_name(FILE)


def _read(path: Path) -> dict[str, ErrorModel]:
    if not path.is_file():
        return {}
    try:
        return {name: ErrorModel(**constants) for name, constants in json.loads(path.read_text()).items()}
    except (OSError, AttributeError, TypeError, ValueError, RecursionError) as error:
        said = f"expected the constants of weights, by their file ({one_line(error)[:300]})"
        raise ValueError(f"{path}: {said}") from error

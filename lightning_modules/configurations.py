"""Lookup of the package's configurations, so that ``-c x4`` and ``-c configs/x4.yaml`` work from any folder."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

# inside an installed package, beside the package in a clone
_FOLDERS = Path(__file__).with_name("configs"), Path(__file__).parents[1] / "configs"


def find_configs(name: str) -> list[str]:
    """Return the files that a name refers to: the user's own file, or else configurations of the package.

    Args:
        name: path of a file, or name in the package, such as ``x4``, with or without ``configs/`` and ``.yaml``. It may
            contain the wildcard ``*``, as in ``ablation/*``. Unknown names are returned unchanged.

    Example:
        >>> [Path(path).name for path in find_configs("data/*")]
        ['films.yaml', 'paper.yaml']
        >>> find_configs("nowhere.yaml")
        ['nowhere.yaml']
    """
    pattern = name.removeprefix("configs/").removesuffix(".yaml") + ".yaml"
    inside = not Path(name).is_absolute() and ".." not in Path(name).parts and name.isprintable() and len(name) < 200
    if not inside or Path(name).is_file():
        return [name]
    found = (sorted(map(str, folder.glob(pattern))) for folder in _FOLDERS)
    return next((files for files in found if files), [name])


def with_found_configs(args: Iterable[str]) -> list[str]:
    """Replace the values of ``-c`` and ``--config`` in a command's arguments by the files that they refer to.

    Example:
        >>> verb, option, path = with_found_configs(["fit", "-c", "x4"])
        >>> verb, option, Path(path).name
        ('fit', '-c', 'x4.yaml')
    """
    found: list[str] = []
    for word in args:
        if found and found[-1] in ("-c", "--config"):
            found.append(find_configs(word)[0])
        elif joined := re.fullmatch(r"(--config=|-c=?)(.+)", word, re.DOTALL):
            found.append(joined[1] + find_configs(joined[2])[0])
        else:
            found.append(word)
    return found

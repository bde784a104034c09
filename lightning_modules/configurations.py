"""Configurations that come with the package: ``-c x4`` and ``-c configs/x4.yaml`` find them from anywhere."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

# in an installed package inside it, in a clone beside it
_FOLDERS = Path(__file__).with_name("configs"), Path(__file__).parents[1] / "configs"


def find_configs(name: str) -> list[str]:
    """Return the files that a configuration is meant by: the user's own, or else those of the package.

    Args:
        name: a file; or one of the package, with ``configs/`` in front and ``.yaml`` behind it or without, in which
            ``*`` stands for anything, such as ``ablation/*``. What names neither is returned as it is.

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
    """Return arguments of a command in which what follows ``-c`` and ``--config`` is a file, where there is one.

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

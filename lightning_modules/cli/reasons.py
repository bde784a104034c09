"""Error messages of jsonargparse, as one line."""

from __future__ import annotations

import re

# lines of jsonargparse around the cause
_AROUND = re.compile(
    r"\s*(- )?(Expected a <class 'NoneType'>|Given value|.*arser key|Does not validate|Subtypes|Errors:|Problem with|$)"
)
_MOST = 500  # characters shown of the cause
# unlikely alternatives
_UNLIKELY = re.compile(r"\s*- Expected a (<class|path|collections)")


def reason(message: str) -> str:
    r"""Return the place and the cause from a message of jsonargparse, which is a tree of alternatives, as one line.

    Example:
        >>> lines = "    - Expected a <class 'int'>", "    - Expected a <class 'NoneType'>", "  Given value: high"
        >>> reason("\n".join(['Parser key "data.height":', *lines]))
        "data.height: expected int, got 'high'"
    """
    if re.search(r"arguments are required: network|class_path 'lightning_modules\.networks\.Network'", message):
        named = "a configuration that names one, such as -c x4, before its overlays"
        return f"expected a network: {named}, or weights (lightning models lists them)"
    lines = message.strip().splitlines() or [message]
    if lines[0].startswith("Problems parsing config"):
        return " ".join(message.split())[:_MOST]
    if not any(line and _AROUND.match(line) for line in lines):
        return message.strip()  # not from jsonargparse; may show a list
    where = [key for line in lines for key in re.findall(r'[Pp]arser key "([^"]+)"', line)]
    inner = [line for line in lines if not _AROUND.match(line)]
    likely = [line for line in inner if not _UNLIKELY.match(line)]
    deepest = max(likely or inner or lines, key=lambda line: len(line) - len(line.lstrip()))
    cause = re.sub(r'^- |[Pp]arser key "[^"]+":\s*', "", deepest.strip())
    given = re.search(r"^ *Given value: (?!Namespace)(.*)$", message, re.MULTILINE)
    kind = re.fullmatch(r"Expected a <class '(\w+)'>(?:\. Got value: (.*))?", cause)
    if kind:
        got = kind[2] or (given[1] if given else None)
        cause = f"expected {kind[1]}" + (f", got {got[:80]!r}" if got else "")
    cause = re.sub("Expected a dot import path string: (.*)", r"expected the name of a class, got \1", cause)
    return ".".join(where) + (": " if where else "") + cause[:_MOST]

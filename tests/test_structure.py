"""Structure of the packages: no circular imports, small folders, and imports in the order of packages."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = "spikekit", "lightning_modules"
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
}

#: the way of the light: none of these imports one that comes later; estimators of flow warp, so warp is before them
WAY = "color", "sensor", "decoders", "warp", "flow", "scenes"


def imported(name, source, modules):
    """Modules that a module imports, at its top or inside its functions."""
    package = name if modules[name].name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            origin = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                inner = f"{origin}.{alias.name}"
                yield inner if inner in modules else origin


def graph(sources, modules=MODULES):
    return {
        name: {other for other in imported(name, source, modules) if other in modules and other != name}
        for name, source in sources.items()
    }


def room(name):
    """The folder of a module; a module that is in none of the rooms is one by itself, and so is a package."""
    parts = name.split(".")
    return ".".join(parts[:2])


def rooms(modules):
    between = {room(name): set() for name in modules}
    for name, others in modules.items():
        # what a package says of itself, such as its version, is below everything
        between[room(name)] |= {room(other) for other in others if other not in PACKAGES} - {room(name)}
    return {name: others for name, others in between.items() if name not in PACKAGES}


def circle(edges):
    try:
        TopologicalSorter(edges).prepare()
    except CycleError as error:
        return error.args[1]
    return None


@pytest.fixture(name="house", scope="module")
def _house():
    return graph({name: path.read_text(encoding="utf-8") for name, path in MODULES.items()})


def test_no_circular_imports_of_modules(house):
    assert circle(house) is None


def test_no_circular_imports_of_packages(house):
    assert circle(rooms(house)) is None


@pytest.mark.parametrize("folder", sorted({path.parent for path in MODULES.values()}), ids=str)
def test_folders_have_few_modules(folder):
    assert len([path for path in folder.glob("*.py") if path.name != "__init__.py"]) <= 13


def test_imports_follow_the_order_of_packages(house):
    order = {f"spikekit.{name}": place for place, name in enumerate(WAY)}
    edges = rooms(house)
    assert set(order) <= set(edges)
    against = [(a, b) for a in order for b in edges[a] if b in order and order[b] > order[a]]
    assert not against


def test_sweep_and_trade_do_not_import_each_other(house):
    edges, pair = rooms(house), {"lightning_modules.sweep", "lightning_modules.trade"}
    assert not [(name, other) for name in pair for other in edges[name] & pair]


def writers(source):
    """Calls that write a file under its own name, as ``open(path, "w")`` or ``path.write_text()``, by their lines."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        function = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        modes = [word.value for word in (*node.args, *(key.value for key in node.keywords)) if _is_mode(word)]
        if function in ("write_text", "write_bytes", "tofile") or (function == "open" and modes):
            yield node.lineno, ast.unparse(node)


def _is_mode(node):
    return isinstance(node, ast.Constant) and node.value in ("w", "wb", "x", "xb", "a", "ab", "r+", "r+b", "w+b")


#: what a module writes otherwise, and why it may
UNWHOLE = {
    "spikekit.io.formats": 1,  # a member of an archive whose file is whole
    "spikekit.io.video_output": 1,  # FFmpeg, under the name of a whole file's part
    "spikekit.timing": 1,  # a switch of Linux in /proc
    "lightning_modules.cli.processes": 1,  # a log, which grows
}


def test_files_are_written_atomically():
    found = {name: list(writers(path.read_text(encoding="utf-8"))) for name, path in MODULES.items()}
    assert {name: len(lines) for name, lines in found.items() if lines} == UNWHOLE, found

"""Declared dependencies match imports; without the extra, operators work and commands name it."""

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

from spikekit.extras import LEARN

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
IMPORTED_AS = {"pillow": "PIL", "scikit-image": "skimage", "pyyaml": "yaml"}


def declared(requirements):
    names = [re.match(r"[\w.-]+", text)[0] for text in requirements]
    return {IMPORTED_AS.get(name, name.replace("-", "_")) for name in names} - {"spikekit"}


def imported():
    """Return the packages that an import statement names anywhere in the two packages."""
    found = set()
    for path in [*ROOT.glob("spikekit/**/*.py"), *ROOT.glob("lightning_modules/**/*.py")]:
        if "bench" in path.parts:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                found.add(node.module.partition(".")[0])
    return found - set(sys.stdlib_module_names) - {"spikekit", "lightning_modules"}


def test_imported_packages_are_exactly_the_declared_ones():
    extras = PROJECT["optional-dependencies"]
    of_users = declared([*PROJECT["dependencies"], *(text for name in extras for text in extras[name])])
    brought_by = {"lightning_fabric"}  # by pytorch_lightning
    assert imported() - brought_by <= of_users
    needed = declared([*PROJECT["dependencies"], *extras["learn"], *extras["fast"], *extras["video"]])
    # the logger of Lightning imports tensorboard
    assert needed - {"tensorboard"} <= imported()
    assert declared(extras["learn"]) - {"kornia_rs"} | brought_by == LEARN  # kornia itself needs kornia_rs


def test_ci_tests_the_lowest_allowed_versions():
    lowest = dict(line.split("==") for line in (ROOT / ".ci" / "lowest.txt").read_text().split("\n")[1:] if line)
    lowest = {name.replace("_", "-"): version.split(".") for name, version in lowest.items()}
    of_users = [*PROJECT["dependencies"]]
    of_users += [text for name in ("learn", "fast", "video") for text in PROJECT["optional-dependencies"][name]]
    for text in of_users:
        name, version = re.fullmatch(r"([\w-]+)(?:\[\w+\])?>=([\d.]+)", text).groups()
        floor = version.split(".")
        assert lowest[name][: len(floor)] == floor, name


WITHOUT = """
import importlib
import sys


class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {missing}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)


sys.meta_path.insert(0, Missing())
"""


COMMANDS = """
import torch
print(spikekit.tfi(torch.ones(9, 4, 4)).sum().item())
for module, words in ("spikekit.cli.command", ["cameras"]), ("lightning_modules.__main__", ["fit", "-c", "x4"]):
    try:
        status = importlib.import_module(module).main(words)
    except SystemExit as error:
        status = error.code
    print(status, file=sys.stderr if isinstance(status, str) else sys.stdout)  # as Python does, which ends with 1
"""


def without_the_extra(code, before=""):
    program = before + WITHOUT.format(missing=LEARN) + code
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=False)


def test_without_the_extra_operators_work_and_commands_name_it():
    """Operators import nothing of it where it is there."""
    heavy = {"pytorch_lightning", "lightning", "lightning_modules", "skimage", "matplotlib", "torchmetrics"}
    light = f"import spikekit, sys\nassert not {heavy} & {{name.partition('.')[0] for name in sys.modules}}\n"
    done = without_the_extra(COMMANDS, light)
    assert (done.returncode, done.stdout) == (0, "144.0\n1\n"), done.stderr
    assert re.fullmatch(r"(\w+: .*spikekit\[learn\].*\n){2}", done.stderr), done.stderr

"""The docs: every operator has a page and a docstring that says all it should, figures draw, the build is clean."""

import builtins
import inspect
import re
import runpy
import subprocess
import sys
import typing
from pathlib import Path

import numpy as np
import pytest
from torch import nn

import spikekit as sk

DOCS = Path(__file__).parents[1] / "docs"
PAGES = {path: path.read_text() for path in sorted(DOCS.rglob("*.rst")) if "_build" not in path.parts}
FIGURES = sorted((DOCS / "figures").glob("*.py"))

MODULES = {
    name: getattr(sk, name)
    for name in sk.__all__
    if inspect.isclass(getattr(sk, name)) and issubclass(getattr(sk, name), nn.Module)
}
FUNCTIONS = {name: getattr(sk, name) for name in sk.__all__ if inspect.isfunction(getattr(sk, name))}


def camel(name):
    return re.sub(r"(?:^|_)([a-z])", lambda letter: letter[1].upper(), name)


WITHOUT_MODULE = [
    "decode_in_chunks",
    "pack_spikes",
    "simulate_spikes",
    "spike_interval_at",
    "tfi_at",
    "tfp_at",
    "unpack_spikes",
]
OPERATORS = [name for name in FUNCTIONS if camel(name) in MODULES] + WITHOUT_MODULE
WITHOUT_EQUATION = {"decode_in_chunks", "unpack_spikes"}
# Indexing and interpolation that every textbook has.
WITHOUT_REFERENCE = {"flow_warp", "merge_bayer", "pack_spikes", "unpack_spikes", "upsample_flow"}


def sections(documented):
    """The parts of a docstring in Google's form, by name; the first, which has none, is the summary."""
    parts = re.split(r"^(\w+):\n", inspect.getdoc(documented), flags=re.MULTILINE)
    return {"Summary": parts[0], **dict(zip(parts[1::2], map(inspect.cleandoc, parts[2::2]), strict=True))}


def items(section):
    """The names that an Args or Raises block explains."""
    return re.findall(r"^(\w+): ", section, flags=re.MULTILINE)


def documented(kind):
    """Where ``.. autofunction::`` and its like name something: {name: page}."""
    found = [(name, path) for path, text in PAGES.items() for name in re.findall(kind + r":: spikekit\.(\w+)", text)]
    assert len(found) == len(dict(found)), "documented twice"
    return dict(found)


def test_every_public_name_is_on_a_page_and_nothing_else():
    assert sorted(documented(r"auto\w+")) == sorted(sk.__all__)


@pytest.mark.parametrize("name", OPERATORS)
def test_operator_has_a_page_with_its_module_and_a_picture(name):
    page = documented("autofunction")[name]
    assert page.parent.name == "operators"
    if name not in WITHOUT_MODULE:
        assert documented("autoclass")[camel(name)] == page
    (figure,) = re.findall(r"^\.\. plot:: (\S+)$", PAGES[page], flags=re.MULTILINE)
    assert page.stem == Path(figure).stem
    assert ":alt: " in PAGES[page]


def test_every_page_under_operators_is_an_operators_and_is_in_the_contents():
    pages = {path for path in PAGES if path.parent.name == "operators"}
    assert pages == {documented("autofunction")[name] for name in OPERATORS}
    for path in PAGES:
        if path.name != "index.rst":
            assert f"   {path.relative_to(DOCS).with_suffix('').as_posix()}\n" in PAGES[DOCS / "index.rst"]


def test_every_figure_is_on_one_page():
    shown = [name for text in PAGES.values() for name in re.findall(r"^\.\. plot:: (\S+)$", text, flags=re.MULTILINE)]
    assert sorted(shown) == [path.name for path in FIGURES]


@pytest.mark.parametrize("name", OPERATORS)
def test_docstring_of_operator(name):
    parts = sections(FUNCTIONS[name])
    assert parts["Summary"].splitlines()[0].endswith(".")
    assert (".. math::" in parts["Summary"]) == (name not in WITHOUT_EQUATION)
    assert len(parts["Convention"]) > 40
    assert (len(parts.get("Reference", "")) > 10) == (name not in WITHOUT_REFERENCE)
    assert list(parts)[1:] == [
        part for part in ("Convention", "Args", "Returns", "Raises", "Example", "Reference") if part in parts
    ]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_docstring_of_function(name):
    function, parts = FUNCTIONS[name], sections(FUNCTIONS[name])
    signature = inspect.signature(function)
    assert items(parts["Args"]) == list(signature.parameters)
    assert ("Returns" in parts) == (typing.get_type_hints(function)["return"] is not type(None))
    raised = items(parts["Raises"])
    assert raised
    for error in raised:
        assert issubclass(getattr(sk, error, None) or getattr(builtins, error), Exception)
    assert ">>> " in parts["Example"]


@pytest.mark.parametrize("name", MODULES)
def test_docstring_of_module(name):
    parts = sections(MODULES[name])
    (function,) = [operator for operator in OPERATORS if camel(operator) == name]
    assert parts["Summary"].splitlines()[0] == f"See the Convention block on :func:`{function}`."
    assert "- Input: " in parts["Shape"]
    assert "- Output: " in parts["Shape"]
    assert ">>> " in parts["Example"]


@pytest.mark.parametrize("script", FIGURES, ids=[path.stem for path in FIGURES])
def test_figure_draws(script):
    matplotlib = pytest.importorskip("matplotlib", reason="figures need matplotlib, see the docs extra")
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    try:
        with matplotlib.rc_context():
            runpy.run_path(str(script))
        figure = plt.gcf()
        figure.canvas.draw()
        for ax in figure.axes:
            for image in ax.images:
                assert image.get_array().min() < image.get_array().max()
            for line in ax.lines:
                assert len(line.get_xdata()) > 0
        assert any(ax.has_data() or ax.tables for ax in figure.axes)
        assert np.asarray(figure.canvas.buffer_rgba()).std() > 5
    finally:
        plt.close("all")


@pytest.mark.slow
def test_docs_build_without_a_warning(tmp_path):
    for needed in ("sphinx", "furo", "matplotlib"):
        pytest.importorskip(needed, reason="the docs extra is not installed")
    command = [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "html", str(DOCS), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for script in FIGURES:
        assert list((tmp_path / "_images").glob(f"{script.stem}*.png"))

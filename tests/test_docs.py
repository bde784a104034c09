"""The docs: complete pages and docstrings of operators, working figures, and a build without warnings."""

import builtins
import doctest
import inspect
import re
import shutil
import textwrap
import typing
from pathlib import Path

import pytest
import torch
from torch import nn

import spikekit as sk
from lightning_modules.__main__ import main as lightning

DOCS = Path(__file__).parents[1] / "docs"
MADE = {"_build", "gallery", "generated", "sg_execution_times.rst"}  # by Sphinx
PAGES = {path: path.read_text() for path in sorted(DOCS.rglob("*.rst")) if not MADE & set(path.parts)}
FIGURES = sorted((DOCS / "figures").glob("*.py"))
EXAMPLES = sorted((DOCS / "examples").glob("*.py"))

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


def documented(kind):
    """Where ``.. autofunction::`` and its like name something: {name: page}."""
    found = [(name, path) for path, text in PAGES.items() for name in re.findall(kind + r":: spikekit\.(\w+)", text)]
    assert len(found) == len(dict(found)), "documented twice"
    return dict(found)


def test_pages_list_exactly_the_public_names():
    assert sorted(documented(r"auto\w+")) == sorted(sk.__all__)


def figures(text):
    return re.findall(r"^\.\. plot:: (\S+)$", text, flags=re.MULTILINE)


@pytest.mark.parametrize("name", OPERATORS)
def test_operators_have_a_page_with_module_and_picture(name):
    page = documented("autofunction")[name]
    assert page.parent.name == "operators"
    if name not in WITHOUT_MODULE:
        assert documented("autoclass")[camel(name)] == page
    (figure,) = figures(PAGES[page])
    assert page.stem == Path(figure).stem
    assert ":alt: " in PAGES[page]


def test_contents_list_every_page_once():
    pages = {path for path in PAGES if path.parent.name == "operators"}
    assert pages == {documented("autofunction")[name] for name in OPERATORS}
    assert sorted(figure for text in PAGES.values() for figure in figures(text)) == [path.name for path in FIGURES]
    contents = []
    for path, text in PAGES.items():
        for block in re.findall(r"^\.\. toctree::\n(?:   :\w+:.*\n)*\n((?:   \S+\n)+)", text, flags=re.MULTILINE):
            for entry in block.split():
                name = DOCS / entry[1:] if entry.startswith("/") else path.parent / entry
                contents.append(name.relative_to(DOCS).as_posix())
    named = {path.relative_to(DOCS).with_suffix("").as_posix() for path in PAGES if "_templates" not in path.parts}
    assert sorted(contents) == sorted(named - {"index", "examples/README"} | {"gallery/index"})


def test_public_names_are_listed_with_their_package():
    listed = {}
    for path, text in PAGES.items():
        if path.parent.name == "api" and ".. autosummary::\n\n" in text:
            for name in text.split(".. autosummary::\n\n")[1].split("\n\n")[0].split():
                assert name not in listed, "in two rooms"
                listed[name] = path.stem
    modules = {camel(name) for name in OPERATORS} & set(MODULES)
    without_room = {"CAMERAS", "PATTERNS", "PictureError", "SpikeFileError", "VideoError", "psnr", "ssim", *modules}
    assert sorted(listed) == sorted(set(sk.__all__) - without_room)
    for name, room in listed.items():
        assert getattr(sk, name).__module__.startswith(f"spikekit.{room}."), name


@pytest.mark.parametrize("name", FUNCTIONS)
def test_docstrings_of_functions_are_complete(name):
    function, parts = FUNCTIONS[name], sections(FUNCTIONS[name])
    explained, raised = (re.findall(r"^(\w+): ", parts[part], flags=re.MULTILINE) for part in ("Args", "Raises"))
    assert explained == list(inspect.signature(function).parameters)
    assert ("Returns" in parts) == (typing.get_type_hints(function)["return"] is not type(None))
    assert raised
    for error in raised:
        assert issubclass(getattr(sk, error, None) or getattr(builtins, error), Exception)
    assert ">>> " in parts["Example"]
    if name in OPERATORS:
        assert parts["Summary"].splitlines()[0].endswith(".")
        assert (".. math::" in parts["Summary"]) == (name not in WITHOUT_EQUATION)
        assert len(parts["Convention"]) > 40
        assert (len(parts.get("Reference", "")) > 10) == (name not in WITHOUT_REFERENCE)
        order = ["Summary", "Convention", "Args", "Returns", "Raises", "Example", "Reference"]
        assert list(parts) == [part for part in order if part in parts]


@pytest.mark.parametrize("name", MODULES)
def test_docstrings_of_modules_are_complete(name):
    parts = sections(MODULES[name])
    (function,) = [operator for operator in OPERATORS if camel(operator) == name]
    assert parts["Summary"].splitlines()[0] == f"See the Convention block on :func:`{function}`."
    assert "- Input: " in parts["Shape"]
    assert "- Output: " in parts["Shape"]
    assert ">>> " in parts["Example"]


def test_quickstart_runs():
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    failed, tried = doctest.testfile(str(DOCS / "quickstart.rst"), module_relative=False, optionflags=flags)
    assert tried > 10
    assert failed == 0


@pytest.mark.slow
@pytest.mark.parametrize(("page", "name"), [("training", "mynet.py"), ("motion", "myflow.py")])
def test_own_networks_and_estimators_work_as_shown(page, name, tmp_path, typed_in, capfd):
    """The file on the page and the commands below it."""
    import pytorch_lightning  # noqa: F401

    text = PAGES[DOCS / "howto" / f"{page}.rst"]
    code, commands = re.search(rf"   # {name}\n((?:   .*\n|\n)+?)\.\. code-block:: sh\n\n((?:   .*\n)+)", text).groups()
    (tmp_path / name).write_text(textwrap.dedent(code))
    sk.write_spikes(tmp_path / "FILE.dat", torch.rand(61, 24, 32) < 0.3)
    few = "--trainer.max_steps 2 --data.train_clips 2 --data.val_clips 1 --data.workers 0 --data.batch_size 1"
    few += " --data.patch 16 --data.val_patch 32" + " --model.network.size tiny" * (page == "motion")
    for command in commands.splitlines():
        arguments = command.replace("250", "24").replace("400", "32").split()[1:]
        if arguments[0] != "predict":
            arguments += few.split()
        assert typed_in(tmp_path, lightning, arguments) == 0, (command, capfd.readouterr().err)
    if page == "training":
        assert (tmp_path / "runs" / "quick" / "test.csv").is_file()
        assert len(list((tmp_path / "out").glob("*.png"))) == 2


@pytest.mark.slow
def test_docs_build_offline_without_warnings(tmp_path, typed_in, capfd):
    """From a copy, as the gallery is written beside its source."""
    for needed in ("sphinx", "furo", "matplotlib", "sphinx_gallery"):
        pytest.importorskip(needed, reason="the docs extra is not installed")
    from sphinx.cmd.build import main as sphinx

    shutil.copytree(DOCS, tmp_path / "docs", ignore=shutil.ignore_patterns(*MADE))
    shutil.copytree(DOCS.parent / "results", tmp_path / "results")
    with (tmp_path / "docs" / "conf.py").open("a") as file:
        file.write('plot_formats = [("png", 40)]\n')  # small figures, and no pages of source
        file.write('extensions.remove("sphinx.ext.viewcode")\n')
    assert typed_in(tmp_path, sphinx, ["-W", "--keep-going", "-q", "docs", "pages"]) == 0, capfd.readouterr().err
    built, formulas = tmp_path / "pages", 0
    for script in FIGURES:
        assert list((built / "_images").glob(f"{script.stem}*.png"))
    for script in EXAMPLES:
        assert list((built / "_images").glob(f"sphx_glr_{script.stem}_*.png"))
        assert (built / "gallery" / f"{script.stem}.html").is_file()
    for page in built.rglob("*.html"):
        html = page.read_text()
        for tag in re.findall(r"<(?:script|link|img|iframe)\b[^>]*>", html):
            if 'rel="canonical"' not in tag:
                assert not re.search(r"""(?:src|href)=["']?(?:https?:)?//""", tag), (page.name, tag)
        formulas += html.count("<math ")
    assert formulas > 100

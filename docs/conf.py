"""How Sphinx builds these pages: ``sphinx-build -W -b html docs docs/_build``."""

import csv
import os
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from unittest.mock import patch

from docutils import nodes
from docutils.statemachine import StringList
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.util.docutils import SphinxDirective

import lightning_modules
import spikekit
from spikekit.cli.command import main

project = "spikekit"
author = copyright = "the spikekit contributors"
version = release = spikekit.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "matplotlib.sphinxext.plot_directive",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["_build", "_templates", "examples", "sg_execution_times.rst", "gallery/sg_execution_times.rst"]
html_math_renderer = "mathml"  # drawn by browsers without network access
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["style.css"]
html_title = f"spikekit {version}"

# An unresolved name in a docstring is an error, unless it belongs to another project.
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(torch|kornia|collections|enum|pathlib|optional|numpy|pytorch_lightning)\b.*"),
    ("py:.*", "(CFA|Tensor|Path)|.*MeasuredPixels"),
    ("py:class", r".*\._\w+"),  # private
]

templates_path = ["_templates"]  # for the pages of autosummary
autosummary_ignore_module_all = False
autodoc_inherit_docstrings = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
maximum_signature_line_length = 80
napoleon_custom_sections = ["Convention", "Shape", "Reference"]

plot_basedir = str(Path(__file__).parent / "figures")
plot_formats = [("png", 160)]
plot_html_show_formats = False
plot_html_show_source_link = True

sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "gallery",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_memory": False,
    "show_signature": False,
    "min_reported_time": 1e9,
    "reset_modules": ("matplotlib",),
}


class Run(SphinxDirective):
    """``.. run:: info --help`` shows what the ``spikekit`` command prints."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self):
        """Return the nodes."""
        self.env.note_reread()  # the output can change without a change of the page
        printed = _spikekit(self.arguments[0])
        return [nodes.literal_block(printed, f"$ spikekit {self.arguments[0]}\n{printed}", language="console")]


def _spikekit(arguments):
    printed, said = StringIO(), StringIO()
    with patch.dict(os.environ, COLUMNS="90"), redirect_stdout(printed), redirect_stderr(said):
        code = main(arguments.split())
    if code:
        raise RuntimeError(f"spikekit {arguments}: {said.getvalue()}")
    return printed.getvalue()


class ShippedTrade(SphinxDirective):
    """``.. shipped-trade:: 4`` shows the table of a scale in the package."""

    required_arguments = 1

    def run(self):
        """Return the nodes."""
        path = Path(lightning_modules.__file__).parent / "weights" / f"x{self.arguments[0]}.csv"
        self.env.note_dependency(str(path))
        rst = StringList(list(_trade(path)), source=self.get_source_info()[0])
        node = nodes.Element()
        self.state.nested_parse(rst, self.content_offset, node)
        return node.children


def _trade(path):
    """Yield the table in reStructuredText, line by line."""
    with path.open(newline="") as file:
        rows = sorted((row for row in csv.DictReader(file) if not row["failed"]), key=lambda row: float(row["ms"]))
    yield from (".. csv-table::", "   :header-rows: 1", "")
    yield '   setting,PSNR (dB),SSIM,"time, ratio",ms per frame,MiB,on the front'
    for row in rows:
        psnr, ssim, ratio, ms, mib = (float(row[name]) for name in ("psnr", "ssim", "ratio", "ms", "mib"))
        on_front = "yes" if row["front"] == "1" else ""
        yield f'   "{row["setting"]}",{psnr:.2f},{ssim:.4f},{ratio:.2g},{ms:.0f},{mib:.0f},{on_front}'


def _inline_math(self, node):
    self.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def _block_math(self, node):
    self.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def _plain_inside(app, env, node, contnode):
    """Show references to parts of lightning_modules without a page as text."""
    return contnode if node["refdoc"].startswith(("generated/", "api/lightning_modules")) else None


def setup(app):
    """Register the directives and the MathML renderer."""
    app.connect("missing-reference", _plain_inside)
    app.add_directive("run", Run)
    app.add_directive("shipped-trade", ShippedTrade)
    app.add_html_math_renderer("mathml", (_inline_math, None), (_block_math, None))

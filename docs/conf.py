"""How Sphinx builds these pages: ``sphinx-build -W -b html docs docs/_build``."""

import os
import re
import subprocess
import sys
from pathlib import Path

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.util.docutils import SphinxDirective

import spikekit

project = "spikekit"
author = "the spikekit contributors"
version = release = spikekit.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "matplotlib.sphinxext.plot_directive",
]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"spikekit {version}"

# A name in a docstring that leads nowhere is an error, except where it belongs to another project.
nitpicky = True
nitpick_ignore_regex = [("py:.*", r"(torch|kornia|collections|pathlib|optional)\b.*"), ("py:.*", "(CFA|Tensor|Path)")]

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
maximum_signature_line_length = 80
napoleon_custom_sections = ["Convention", "Shape", "Reference"]

plot_basedir = str(Path(__file__).parent / "figures")
plot_formats = [("png", 160)]
plot_html_show_formats = False
plot_html_show_source_link = True


class Run(SphinxDirective):
    """``.. run:: info --help`` shows what the ``spikekit`` command prints, with ``--markdown`` as tables."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self):
        """Return the nodes."""
        self.env.note_reread()  # what it prints can change without a change of the page
        printed = _spikekit(self.arguments[0])
        if "--markdown" not in self.arguments[0]:
            return [nodes.literal_block(printed, f"$ spikekit {self.arguments[0]}\n{printed}", language="console")]
        rst = StringList(list(_restructured(printed)), source=self.get_source_info()[0])
        node = nodes.Element()
        self.state.nested_parse(rst, self.content_offset, node)
        return node.children


def _spikekit(arguments):
    main = "import sys; from spikekit.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", main, *arguments.split()]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "COLUMNS": "90"}, check=False)
    if done.returncode:
        raise RuntimeError(f"spikekit {arguments}: {done.stderr}")
    return done.stdout


def _restructured(markdown):
    """Markdown's headings, tables and code as lines of reStructuredText."""
    header = True
    for line in markdown.splitlines():
        if not line.startswith("|"):
            header = True
            yield f".. rubric:: {_inline(line.lstrip('# '))}" if line.startswith("#") else _inline(line)
            continue
        if header:
            yield from ("", ".. list-table::", "   :header-rows: 1", "")
        header = False
        if not set(line) <= set("|-: "):
            for i, cell in enumerate(line.strip("|").split("|")):
                yield f"   {'  -' if i else '* -'} {_inline(cell.strip())}"


def _inline(text):
    """Keep what is between backticks as code, and let nothing else mean anything."""
    parts = text.split("`")
    return "".join(f"``{part}``" if i % 2 else re.sub(r"([*_|\\])", r"\\\1", part) for i, part in enumerate(parts))


def setup(app):
    """Register the directive."""
    app.add_directive("run", Run)

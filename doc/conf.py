"""Sphinx configuration that builds the pages of this folder as a site, for ``make docs`` and for rosdoc2.

rosdoc2 runs this file from a copy of the folder; some of its versions set project and version only afterwards. It has
neither MyST-NB nor latex2mathml nor NumPy: its site shows the code of the notebooks without results, draws formulas by
MathJax, and has no Python reference.
"""

from __future__ import annotations

import importlib.util
import os
import re
import sys
from html import escape
from pathlib import Path
from xml.etree import ElementTree

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.directives.code import CodeBlock
from sphinx.writers.html5 import HTML5Translator

try:
    from latex2mathml.converter import convert
except ImportError:
    convert = None

ROOT = Path(__file__).resolve().parents[1]
project = "hexapod_comp"
author = copyright = "The hexapod_comp maintainers"
if (ROOT / "package.xml").is_file():
    # For a package that is not installed, and for the notebooks, which run in other processes.
    sys.path.insert(0, str(ROOT))
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    release = version = ElementTree.parse(ROOT / "package.xml").findtext("version") or ""
else:
    release = version = globals().get("release", "")

NOTEBOOKS = importlib.util.find_spec("myst_nb") is not None
REFERENCE = importlib.util.find_spec("numpy") is not None

extensions = ["sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
extensions.insert(0, "myst_nb" if NOTEBOOKS else "myst_parser")
exclude_patterns = ["_build", "**/templates", "templates", *([] if REFERENCE else ["**/api.md", "api.md"])]
templates_path = ["templates"]

html_theme = "furo"
html_title = f"hexapod_comp {release}".strip()
html_static_path = ["static"]
html_css_files = ["site.css"]
if convert:
    html_math_renderer = "mathml"  # the browser draws it without a script or the network

# Every heading is a link target, as on hosting sites that show the pages without building them.
myst_heading_anchors = 3
myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]

# The notebooks run at each build, so they show the results of the present code.
nb_execution_mode = "force"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

autosummary_generate = True
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
default_role = "literal"  # `size` in a docstring is the name of an argument
suppress_warnings = ["ref.python"]  # napoleon finds an attribute by its name alone, even if two classes share it
if not REFERENCE:
    suppress_warnings += ["toc.excluded", "toc.not_readable"]  # api.md is excluded
if not (ROOT / "package.xml").is_file():
    suppress_warnings.append("myst.xref_missing")  # the copy has no files outside doc/


def inline_math(writer: HTML5Translator, node: nodes.math) -> None:
    """Write an inline formula as MathML."""
    writer.body.append(convert(node.astext()))
    raise nodes.SkipNode


def block_math(writer: HTML5Translator, node: nodes.math_block) -> None:
    """Write a displayed formula as MathML; a wide formula scrolls."""
    writer.body.append(f'<div class="math">{convert(node.astext(), display="block")}</div>')
    raise nodes.SkipNode


MANY = 6
"""Number of columns from which a table of prose stacks the cells of a row on any screen."""

PROSE = 45
"""Characters in a cell from which its table counts as prose, not as a table of numbers."""

LONG = re.compile(r"_msgs/|\S{30}")


def label_cells(_app: Sphinx, tree: nodes.document, _name: str) -> None:
    """Label each cell of a table of prose with its column's name, for narrow screens, which stack the cells of a row.

    Names longer than 30 characters and names of message types may break after an underscore, a slash or a colon.
    """
    for table in tree.findall(nodes.table):
        entries = list(table.findall(nodes.entry))
        if max((len(entry.astext()) for entry in entries), default=0) < PROSE:
            continue
        columns = max(len(list(row.findall(nodes.entry))) for row in table.findall(nodes.row))
        table["classes"].append("prose" if columns < MANY else "cards")
        head = next(iter(table.findall(nodes.thead)), None)
        names = [entry.astext() for entry in head.findall(nodes.entry)] if head else []
        for row in (row for body in table.findall(nodes.tbody) for row in body.findall(nodes.row)):
            for entry, name in zip(row.findall(nodes.entry), names, strict=False):
                entry["label"] = name
        for text in [text for text in table.findall(nodes.Text) if LONG.search(text)]:
            parts = [nodes.Text(part) for part in re.split(r"(?<=[_/:])(?=\w)", text)]
            breaks = [nodes.raw("", "<wbr>", format="html") for _ in parts[1:]]
            text.parent.replace(
                text, [node for pair in zip(parts, [*breaks, nodes.Text("")], strict=True) for node in pair]
            )


def labelled_cell(writer: HTML5Translator, entry: nodes.entry) -> None:
    """Write a table cell with its label as an attribute, which the style sheet shows."""
    HTML5Translator.visit_entry(writer, entry)
    if entry.get("label"):
        opened = next(n for n in reversed(range(len(writer.body))) if writer.body[n].startswith(("<td", "<th")))
        writer.body[opened] = writer.body[opened].replace("<td", f'<td data-label="{escape(entry["label"])}"', 1)


def keep_bars(_app: Sphinx, _what: str, _name: str, _thing: object, _options: object, lines: list[str]) -> None:
    """Escape the bars of a magnitude |x| in a docstring, which reStructuredText would take for a substitution."""
    lines[:] = [re.sub(r"(``.*?``)|\|", lambda match: match[1] or r"\|", line) for line in lines]


class CodeCell(CodeBlock):
    """Directive that shows the code of a notebook's cell without running it, if MyST-NB is not installed."""

    option_spec = CodeBlock.option_spec | {"tags": lambda text: text}


def setup(app: Sphinx) -> None:
    """Register the writers of formulas and table cells, and the handler of docstrings."""
    if not NOTEBOOKS:
        app.add_directive("code-cell", CodeCell)
    if convert:
        app.add_html_math_renderer("mathml", (inline_math, None), (block_math, None))
    app.connect("autodoc-process-docstring", keep_bars)
    app.connect("doctree-resolved", label_cells)
    app.add_node(nodes.entry, override=True, html=(labelled_cell, HTML5Translator.depart_entry))

"""The pages of this folder as a site: ``make docs``, or rosdoc2, which finds this file where ROS packages keep it."""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]

project = "hexapod_comp"
author = "The hexapod_comp maintainers"
copyright = author
release = version = ElementTree.parse(ROOT / "package.xml").findtext("version") or ""

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
source_suffix = {".md": "myst-nb"}
exclude_patterns = ["_build"]

html_theme = "furo"
html_title = f"hexapod_comp {release}"

# Every heading is a target, as where the pages are read without being built.
myst_heading_anchors = 3
myst_enable_extensions = ["dollarmath"]

# The notebooks run at each build: what they show is what the package does now.
nb_execution_mode = "force"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

autosummary_generate = True
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
# A page of the kernels would say nothing: compiled functions take arrays, and their docstrings stand in the source.
napoleon_google_docstring = False
napoleon_use_rtype = False

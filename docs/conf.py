"""Sphinx: Markdown pages, notebooks as they were committed, API reference from the docstrings; everything offline."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import latex2mathml.converter
from docutils import nodes
from sphinx.application import Sphinx

import torchrl_pomdp

project = "torchrl_pomdp"
author = "The torchrl_pomdp contributors"
project_copyright = author
release = torchrl_pomdp.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
# Results, benchmarks and notebooks are pages too: Sphinx wants them below its own folder.
HERE = Path(__file__).parent
for name in ("results", "tutorials", "benchmarks"):
    shutil.rmtree(HERE / name, ignore_errors=True)
    shutil.copytree(HERE.parent / name, HERE / name, ignore=shutil.ignore_patterns("*.py", "*.json"))
# Tables that the pages of results show already.
exclude_patterns = ["_build", "results/*/*-scale*.md", "results/compare/compare-*.md", "results/proposition1/proposition1.md"]
exclude_patterns += ["results/changes/model-changes.md", "results/asynchronous/linear20*.md"]
source_suffix = {".md": "myst-nb", ".ipynb": "myst-nb", ".rst": "restructuredtext"}

myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "off"

autodoc_typehints = "none"
autodoc_member_order = "bysource"
napoleon_use_ivar = True
napoleon_use_rtype = False

html_theme = "furo"
html_title = f"torchrl_pomdp {release}"
html_show_sourcelink = False
html_static_path = ["_static"]
html_css_files = ["tables.css"]
html_math_renderer = "mathml"


def _inline(translator: Any, node: nodes.math) -> None:
    translator.body.append(latex2mathml.converter.convert(node.astext()))
    raise nodes.SkipNode


def _block(translator: Any, node: nodes.math_block) -> None:
    translator.body.append(f'<div class="formula">{latex2mathml.converter.convert(node.astext(), display="block")}</div>')
    raise nodes.SkipNode


def _beside(app: Sphinx, page: str, source: list[str]) -> None:
    """Pages link results and tutorials where they are in the repository; for Sphinx they lie beside its own pages."""
    up = "../" * page.count("/")
    if not page.startswith(("results/", "tutorials/", "benchmarks/")):
        source[0] = re.sub(rf"\]\({re.escape(up)}\.\./(results|tutorials)/", rf"]({up}\1/", source[0])


def setup(app: Sphinx) -> None:
    """Formulas become MathML, which browsers draw without any script from elsewhere."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    app.connect("source-read", _beside)

"""The pages of docs/ as a site: `python -m sphinx -W --keep-going -b html docs build/site`.

Pages are read in the repository as well, where `../configs` leads somewhere: on the site a link out of docs/ becomes
the path that it leads to. Formulas become MathML, so that the site needs no script of others and nothing is fetched.
"""

from __future__ import annotations

import posixpath
import re
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

project = "robcal"
author = "robcal developers"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
suppress_warnings = ["myst.header"]  # pages may begin a level deeper where a table of contents does
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
napoleon_google_docstring = False
napoleon_use_ivar = True
html_theme = "furo"
html_title = "robcal"
html_math_renderer = "mathml"
html_show_sphinx = False
html_copy_source = False
nitpicky = False

LINK = re.compile(r"\[(?P<text>[^\]]+)\]\((?P<target>\.\.?/[^)#]+)(?:#[^)]*)?\)")


def links_out(app: Sphinx, name: str, source: list[str]) -> None:
    """Links that leave docs/ become paths."""

    def path(found: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join("docs", posixpath.dirname(name), found["target"]))
        if target.startswith("docs/"):
            return found[0]
        return f"`{target}`" if found["text"].strip("`") in target else f"{found['text']} (`{target}`)"

    source[0] = LINK.sub(path, source[0])


def inline_formula(translator: HTML5Translator, node: nodes.math) -> None:
    """A formula within a line, as MathML."""
    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def displayed_formula(translator: HTML5Translator, node: nodes.math_block) -> None:
    """A formula on lines of its own, as MathML."""
    translator.body.append(f'<div class="math">{convert(node.astext(), display="block")}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    """Called by Sphinx."""
    app.add_html_math_renderer("mathml", (inline_formula, None), (displayed_formula, None))
    app.add_lexer("csv", TextLexer)
    app.connect("source-read", links_out)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

"""From chapters to one HTML file: template, style and script inlined, every text escaped."""

import base64
import hashlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from pipeline.report.blocks import Bullets, Chapter, Figure, Pictures, Table, Text, Verdict
from pipeline.report.provenance import Provenance

_HERE = Path(__file__).parent


def render(name: str, verdict: Verdict, chapters: Sequence[Chapter], source: Provenance) -> str:
    """The report as HTML.

    A content security policy forbids every request and every script but the two inlined here (by their hashes).
    """
    figures = any(isinstance(b, Figure) for chapter in chapters for b in chapter.blocks)
    scripts = [*([get_plotlyjs()] if figures else []), _text("report.js")]
    return (
        _environment()
        .get_template("report.html")
        .render(
            name=name,
            verdict=verdict,
            chapters=chapters,
            source=source,
            style=Markup(_text("style.css")),
            scripts=[Markup(script) for script in scripts],
            hashes=[_hash(script) for script in scripts],
        )
    )


@cache
def _text(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")


def _hash(script: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    kinds = {"is_text": Text, "is_bullets": Bullets, "is_table": Table, "is_figure": Figure, "is_pictures": Pictures}
    for test, kind in kinds.items():
        environment.tests[test] = lambda value, kind=kind: isinstance(value, kind)
    environment.filters["script_json"] = Markup  # Figure.payload is made safe for a script element
    return environment

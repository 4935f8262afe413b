"""From chapters to one HTML file: template, style and script inlined, every text escaped.

Where a report comes from: version, settings, hashes of the inputs.
"""

import base64
import gzip
import hashlib
import json
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from pipeline.json_io import plain
from pipeline.report.blocks import Bullets, Chapter, Figure, Pictures, Table, Text, Verdict, script_json
from pipeline.report.material import Material
from pipeline.report.style import NIGHT
from pipeline.sources import all_modules, code_version

_LIBRARIES = ("numpy", "scipy", "casadi", "opencv-contrib-python-headless", "pycolmap")


@dataclass(frozen=True)
class Provenance:
    """Facts for the end of the report.

    Attributes
    ----------
    facts : (name, value); inputs : (file, SHA-256); settings : campaign.yaml as it was understood, as JSON.
    """

    facts: tuple[tuple[str, str], ...]
    inputs: tuple[tuple[str, str], ...]
    settings: str


def provenance(material: Material) -> Provenance:
    """Version of the program, inputs and settings. No time of writing: the same run gives the same report."""
    facts = [
        ("campaign", str(material.campaign_folder)),
        ("program", f"robcal {_version('robcal')}, sources {code_version(*all_modules())[:16]}"),
        ("Python", platform.python_version()),
        ("libraries", ", ".join(f"{name} {_version(name)}" for name in _LIBRARIES)),
        ("stages", ", ".join(material.stages)),
    ]
    campaign = material.campaign
    if campaign is None:
        facts.append(("inputs", "the campaign is gone or has changed: its files cannot be listed"))
        return Provenance(tuple(facts), (), "")
    settings = json.dumps(plain(campaign.entry.model_dump(exclude_defaults=True)), indent=1, ensure_ascii=False)
    inputs = [(_short(path, material.campaign_folder), material.run.hash(path)) for path in campaign.files]
    index = material.detections
    if index is not None:
        inputs += [
            (_short(e.path, material.campaign_folder), material.run.hash(e.path))
            for e in index.entries
            if e.path.is_file()
        ]
    return Provenance(tuple(facts), tuple(dict.fromkeys(inputs)), settings)


def _short(path: Path, folder: Path) -> str:
    try:
        return str(path.resolve().relative_to(folder.resolve()))
    except ValueError:
        return str(path)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "(not installed)"


_HERE = Path(__file__).parent


def render(
    name: str, verdict: Verdict, chapters: Sequence[Chapter], source: Provenance, poses: Sequence[str] = ()
) -> str:
    """The report as HTML; ``poses`` are the names behind the numbers that plots, rows and images carry.

    A content security policy forbids every request and every script but the two inlined here (by their hashes): our
    own, and Plotly, which lies packed in the page and is unpacked by it.
    """
    figures = any(isinstance(b, Figure) for chapter in chapters for b in chapter.blocks)
    library = get_plotlyjs() if figures else ""
    script = _text("report.js")
    return (
        _environment()
        .get_template("report.html")
        .render(
            name=name,
            verdict=verdict,
            chapters=chapters,
            source=source,
            style=Markup(_text("style.css")),
            script=Markup(script),
            library=_packed(library) if library else "",
            hashes=[_hash(text) for text in (script, library) if text],
            night=Markup(script_json(NIGHT)),
            poses=poses,
            poses_json=Markup(script_json(poses)),
        )
    )


@cache
def _text(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")


def _packed(script: str) -> str:
    """Packed and in letters; the same script gives the same letters."""
    return base64.b64encode(gzip.compress(script.encode(), 9, mtime=0)).decode("ascii")


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

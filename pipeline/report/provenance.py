"""Where a report comes from: version, settings, hashes of the inputs."""

import json
import platform
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from pipeline.json_io import plain
from pipeline.report.material import Material
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

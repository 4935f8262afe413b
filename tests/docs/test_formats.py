"""docs/formats.md against the code: every key of the files, every cause of the library."""

import re
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel

from pipeline.campaign_schema import CampaignEntry
from robcal.files.body_file import BodyEntry
from robcal.files.camera_file import CameraEntry
from robcal.files.line_cameras import LineCamerasEntry
from robcal.files.reseau_file import ReseauEntry
from robcal.files.robot_file import RobotEntry
from robcal.physics.library import kinds

PAGE = (Path(__file__).parents[2] / "docs" / "formats.md").read_text(encoding="utf-8")
CODE = " ".join(re.findall(r"`([^`]*)`", PAGE))
ELSEWHERE = {"unknown": None}
"""Causes of which the stage is 'any'."""


def models(annotation: Any) -> set[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {annotation}
    return {model for inner in get_args(annotation) for model in models(inner)}


def keys(entry: type[BaseModel]) -> set[str]:
    found = set(entry.model_fields)
    for field in entry.model_fields.values():
        for model in models(field.annotation):
            found |= keys(model)
    return found


@pytest.mark.parametrize("entry", [CampaignEntry, RobotEntry, BodyEntry, CameraEntry, LineCamerasEntry, ReseauEntry])
def test_every_key_stands_on_the_page(entry: type[BaseModel]) -> None:
    missing = {key for key in keys(entry) if not re.search(rf"\b{key}\b", CODE)}
    assert not missing


def test_every_cause_stands_in_the_table_with_its_stage() -> None:
    rows = [line.split("|") for line in PAGE.splitlines() if line.startswith("| `")]
    table = {name: cells[2].strip() for cells in rows for name in re.findall(r"`(\w+)`", cells[1])}
    for name, kind in kinds().items():
        assert name in table, name
        assert name in ELSEWHERE or table[name] == kind.stage, name

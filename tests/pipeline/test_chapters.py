"""Chapters of the report say what the run holds: each from a small run of points, one pose of which is spoilt."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.report.blocks import Figure, Table
from pipeline.report.material import Material
from pipeline.report.measurement_chapters import measurement_chapter
from pipeline.report.notes_chapter import rejected_chapter
from pipeline.report.robot_plot import robot_figure
from pipeline.report.verdict import verdict_of
from pipeline.report.verification_chapter import error_table, noise_by_tool, verification_chapter
from pipeline.runner import run_campaign
from pipeline.runs import open_run


@pytest.fixture(scope="module")
def material(point_campaign_source: Path, tmp_path_factory: pytest.TempPathFactory) -> Material:
    folder = tmp_path_factory.mktemp("chapters") / "run"
    run_campaign(point_campaign_source, folder, until="verify")
    return Material(open_run(folder))


def test_verdict_quotes_the_verification(material: Material) -> None:
    assert material.verification is not None
    verdict = verdict_of(material)
    mean = 1e3 * material.verification[0].tools["0"].mean
    quoted = [float(word) for word in verdict.sentence.replace("(", " ").split() if word.replace(".", "", 1).isdigit()]
    assert any(abs(value - mean) < 0.01 * mean for value in quoted)


def test_table_of_errors_has_a_row_for_every_tool(material: Material) -> None:
    assert material.verification is not None
    verification = material.verification[0]
    noise = noise_by_tool(material)
    full = error_table(verification, noise, full=True)
    assert isinstance(full, Table)
    assert len(full.rows) >= len(verification.tools)
    assert all(len(row) == len(full.columns) for row in full.rows)


def test_chapters_have_what_they_promise(material: Material) -> None:
    for chapter in (verification_chapter(material), measurement_chapter(material)):
        figures = [block for block in chapter.blocks if isinstance(block, Figure)]
        assert figures
        assert all(figure.alt and figure.caption for figure in figures)
        assert all("NaN" not in figure.payload for figure in figures)
    assert rejected_chapter(material).blocks


def test_the_robot_is_drawn_with_the_place_of_a_cause(material: Material) -> None:
    cause = {
        "cause": "backlash",
        "stage": "robot",
        "where": "axis3",
        "direction": "y",
        "parameters": {"width_deg": 0.02},
    }
    marked = robot_figure(material, [cause])
    assert robot_figure(material, []) is None
    assert marked is not None
    assert "axis 3" in marked.caption
    traces = [(trace["x"], trace["y"], trace["z"]) for trace in marked.data]
    points = np.array([xyz for trace in traces for xyz in zip(*trace, strict=True)], dtype=float)
    assert np.nanmax(np.abs(points)) < 1e4

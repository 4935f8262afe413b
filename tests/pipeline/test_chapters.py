"""Chapters of the report say what the run holds: each from a small run of points, one pose of which is spoilt."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from pipeline.report.blocks import Figure, Table
from pipeline.report.comparison import write_comparison
from pipeline.report.material import Material
from pipeline.report.measurement_chapters import measurement_chapter
from pipeline.report.notes_chapter import rejected_chapter
from pipeline.report.robot_plot import robot_figure
from pipeline.report.style import number
from pipeline.report.verdict import verdict_of
from pipeline.report.verification_chapter import _repeated, error_table, noise_by_tool, verification_chapter
from pipeline.runner import run_campaign
from pipeline.runs import open_run
from robcal.calibration.observations import FrameObservations


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


def test_a_run_compared_with_itself_has_not_changed(material: Material) -> None:
    path = write_comparison(material.run, material.run)
    page = path.read_text(encoding="utf-8")
    assert "Nothing changed beyond what the measurements leave open" in page
    assert "Errors of both runs, pose by pose" in page
    assert number(material.result["verification"]["tools"]["0"]["mean"]) in page


def test_terms_of_iso_9283_from_poses_driven_again(material: Material) -> None:
    """The recorded tools of a run, visited in twelve cycles with a known shift."""
    robot, found = material.calibrated, material.identification
    assert robot is not None
    assert found is not None
    assert robot.q is not None
    assert robot.tools is not None
    rows = np.tile([0, 1, 2], 12)
    shifted = robot.tools[rows].copy()
    shifted[:, 0, 3] += 1e-4
    seen = FrameObservations.isotropic(shifted, 1e-5, 1e-4)
    again = SimpleNamespace(
        calibrated=replace(robot, q=robot.q[rows], tools=robot.tools[rows]),
        identification=SimpleNamespace(recording=SimpleNamespace(observations=(seen,))),
        campaign=None,
    )
    (shown,) = _repeated(cast(Material, again))
    assert isinstance(shown, Table)
    told = {row[0].split(",")[0]: row[1] for row in shown.rows}
    assert told["AP"] == number(0.1)
    assert float(told["RD"]) < 1e-9
    assert "asks for 30 cycles" in shown.caption

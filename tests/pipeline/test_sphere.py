"""A calibration sphere from rendered photographs to coordinates: dots on a curved surface, seen from one side each."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from fixtures.bodies import target_sphere
from fixtures.campaign_writer import write_image_campaign
from fixtures.image_campaign import full_campaign
from pipeline.cli import app

RADIUS = 0.2


@pytest.mark.slow
def test_sphere_is_surveyed_from_images(tmp_path: Path) -> None:
    plan = full_campaign(
        seed=3, survey_images=30, identify=0, verify=0, sphere=True, width=1280, height=1024, focal_mm=8.0, pixel_um=4.8
    )
    body = target_sphere(radius=RADIUS, coded=48, dots=60, diameter=0.008, seed=3)
    survey = replace(next(s for s in plan.surveys if s.name == "sphere"), body=body, bar_sigma=1e-6)
    campaign = write_image_campaign(replace(plan, surveys=(survey,)), tmp_path / "campaign", tmp_path / "truth")
    out = tmp_path / "run"
    done = CliRunner().invoke(app, ["survey", str(campaign), "--body", "sphere", "--out", str(out), "-q", "--json"])
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)["survey"]["sphere"]
    assert result["targets"] >= 100
    assert abs(result["length_error_mm"]) < 0.05

    rows = yaml.safe_load((out / "bodies" / "sphere.yaml").read_text(encoding="utf-8"))["targets"]
    rows = [row for row in rows if row["id"] in set(body.ids.tolist()) and row["code"] == "ring12"]
    points = np.array([row["xyz_mm"] for row in rows]) / 1e3
    true = body.points[[body.index(row["id"]) for row in rows]]
    a, b = points - points.mean(axis=0), true - true.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    turn = u * [1.0, 1.0, np.sign(np.linalg.det(u @ vt))] @ vt
    rms = np.sqrt(np.mean((a @ turn.T - b) ** 2))
    sigma = np.sqrt(np.mean(np.square([row["sigma_mm"] for row in rows]))) / 1e3
    assert rms < 10e-6
    assert rms < 3.0 * sigma
    # the size of the sphere itself: dots of 8 mm end 40 um below its surface
    design = np.column_stack([2 * points, np.ones(len(points))])
    solution = np.linalg.lstsq(design, np.sum(points**2, axis=1), rcond=None)[0]
    assert np.sqrt(solution[3] + solution[:3] @ solution[:3]) == pytest.approx(RADIUS, abs=10e-6)
    normals = np.array([row["normal"] for row in rows if "normal" in row])
    assert len(normals) > 0.9 * len(rows)

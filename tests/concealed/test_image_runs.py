"""The level of rendered images: what is run, and how its answers are scored."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.concealed.image_runs import NEED_SURVEY, NULLS, image_runs, run_imaged
from benchmarks.concealed.own_scoring import own_scores, true_T_surveyed
from fixtures.campaigns import write_yaml
from fixtures.effects import Effect
from fixtures.own_images import IMAGE_CAUSES, image_plan
from fixtures.own_station import OwnTruth, draw_own
from fixtures.rigid import frame_from_six, inverse, move


def _told(cause: str, where: object, stage: str = "image") -> dict[str, Any]:
    return {"cause": cause, "where": where, "stage": stage, "direction": None, "parameters": {}, "sigma": {}}


@pytest.fixture(scope="module")
def truth() -> OwnTruth:
    return draw_own(image_plan(2, poses=12, verify=2, kept_out=2))


def test_every_cause_is_run_once_a_battery_and_what_needs_a_survey_has_one() -> None:
    runs = list(image_runs("singles", 2, 500))
    assert [r.label for r in runs] == 2 * list(IMAGE_CAUSES)
    assert len({r.key for r in runs}) == len(runs)
    assert all(r.photographs.survey_images for r in runs if r.label in NEED_SURVEY)
    assert {r.snr for r in runs if r.label == "hysteresis"} == {12.0, 30.0}
    assert [r.label for r in image_runs("nulls", 1, 0)] == list(NULLS)


def test_dots_of_unknown_size_show_in_every_camera(truth: OwnTruth) -> None:
    dots = Effect("ellipse_eccentricity", "station", None, {"diameter_mm": 50.0})
    told = [_told("ellipse_eccentricity", "left"), _told("ellipse_eccentricity", "right")]
    both = own_scores(truth, dots, {"causes": told, "next_poses": []})
    assert both["exact"]
    assert both["extras"] == 0
    assert not own_scores(truth, dots, {"causes": [_told("centroid_bias", "left")], "next_poses": []})["exact"]


def test_a_lens_is_that_of_its_camera(truth: OwnTruth) -> None:
    lens = Effect("lens_radial", "survey", None, {"k1": -0.08, "k2": 0.0})
    found = own_scores(truth, lens, {"causes": [_told("lens_radial", "survey", "camera")], "next_poses": []})
    assert found["name_right"]
    other = own_scores(truth, lens, {"causes": [_told("lens_radial", "left", "camera")], "next_poses": []})
    assert not other["name_right"]
    assert other["stage_right"]


def test_frames_of_a_surveyed_body_are_brought_to_the_true_one(truth: OwnTruth, tmp_path: Path) -> None:
    moved = frame_from_six([0.01, 0.02, -0.03, 0.1, 0.2, 0.3])
    points = move(moved, truth.points) * 1000.0
    targets = [{"id": i, "xyz_mm": p.tolist()} for i, p in zip(truth.ids, points, strict=True)]
    write_yaml(tmp_path / "plate.yaml", {"format": "robcal/body-1", "targets": targets})
    np.testing.assert_allclose(true_T_surveyed(truth, tmp_path / "plate.yaml"), inverse(moved), atol=1e-6)
    np.testing.assert_array_equal(true_T_surveyed(truth, tmp_path / "none.yaml"), np.eye(4))


@pytest.mark.slow
def test_a_campaign_from_its_images_to_its_score() -> None:
    run = next(r for r in image_runs("singles", 1, 7000) if r.label == "backlash")
    record = run_imaged(replace(run, seed=7001, snr=30.0))
    assert "error" not in record, record.get("traceback")
    assert record["name_right"]
    assert record["after_inside"] < record["before_inside"]
    json.dumps(record)

"""Campaigns with a printed board, from rendered images to cameras, coordinates and frames."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from fixtures.board_pattern import BoardPattern
from fixtures.board_scene import render_board
from fixtures.rigid import Array, inverse
from fixtures.viewing import look_at
from pipeline.runner import run_campaign
from robcal.errors import InvalidInput
from robcal.files.body_file import board_entry, read_body
from tests.photogrammetry.boards.rendered import CAMERA as LARGE
from tests.photogrammetry.boards.rendered import layout

CAMERA = replace(LARGE, width=480, height=360, fx=520.0, fy=520.0, cx=241.0, cy=178.0)
CHARUCO = BoardPattern("charuco", 7, 5, square=0.03, marker=0.022)
CIRCLES = BoardPattern("asymmetric_circles", 4, 9, spacing=0.02, diameter=0.017)


def _middle(pattern: BoardPattern) -> Array:
    left, top, right, bottom = pattern.sheet()
    return np.array([(left + right) / 2, (top + bottom) / 2, 0.0])


def _views(pattern: BoardPattern, count: int, seed: int, turned: bool = True) -> list[Array]:
    """camera_T_board of photographs from the front, from all around, also with the camera turned."""
    rng = np.random.default_rng(seed)
    views = []
    for k in range(count):
        side = rng.uniform(0.1, 0.3)
        around = 2 * np.pi * k / count + rng.uniform(0, 0.5)
        away = np.array([side * np.cos(around), side * np.sin(around), -rng.uniform(0.35, 0.5)])
        eye = _middle(pattern) + away
        roll = (k % 4) * np.pi / 2 if turned else rng.uniform(-0.2, 0.2)
        views.append(inverse(look_at(eye, _middle(pattern) + rng.uniform(-0.02, 0.02, 3), roll=roll, up=(0, -1, 0))))
    return views


def _photograph(folder: Path, pattern: BoardPattern, views: Sequence[Array], names: Sequence[str]) -> None:
    folder.mkdir(parents=True)
    for k, (name, view) in enumerate(zip(names, views, strict=True)):
        cv2.imwrite(str(folder / f"{name}.png"), render_board(pattern, CAMERA, view, seed=k, sub=3).image)


def _write(path: Path, content: dict[str, Any]) -> None:
    path.write_text(yaml.safe_dump(content, sort_keys=False))


def _body(path: Path, pattern: BoardPattern) -> None:
    _write(path, {"format": "robcal/body-1", "board": dict(board_entry(layout(pattern)))})


@pytest.mark.parametrize("pattern", [CHARUCO, CIRCLES])
def test_survey_of_a_board_calibrates_the_camera(tmp_path: Path, pattern: BoardPattern) -> None:
    _photograph(tmp_path / "images", pattern, _views(pattern, 6, 1), [f"im{k}" for k in range(6)])
    _body(tmp_path / "board.yaml", pattern)
    campaign = {
        "format": "robcal/campaign-1",
        "name": "board",
        "bodies": {"board": {"targets": "board.yaml", "survey": {"images": "images"}}},
    }
    _write(tmp_path / "campaign.yaml", campaign)
    done = run_campaign(tmp_path, tmp_path / "run", until="survey", workers=1)
    survey = done.result["survey"]["board"]
    assert survey["targets"] == len(pattern.marks())
    assert survey["rms_px"] < 0.02
    surveyed = read_body(tmp_path / "run" / "bodies" / "board.yaml")
    assert surveyed.board == layout(pattern)
    points = np.array([t.xyz for t in surveyed.targets])
    assert np.abs(points[:, :2] - pattern.marks()).max() < 2e-5


def test_station_that_watches_a_board(tmp_path: Path) -> None:
    names = [f"p{k}" for k in range(6)]
    left_T_right = look_at(np.array([0.2, 0.0, 0.0]), np.array([0.0, 0.0, 0.5]), up=(0, -1, 0))
    left_T_board = _views(CHARUCO, 6, 7, turned=False)
    _photograph(tmp_path / "left", CHARUCO, left_T_board, names)
    _photograph(tmp_path / "right", CHARUCO, [inverse(left_T_right) @ v for v in left_T_board], names)
    _body(tmp_path / "board.yaml", CHARUCO)
    camera = {"format": "robcal/camera-1", "width": 480, "height": 360, "model": "opencv"}
    values = {"fx": 510.0, "fy": 510.0, "cx": 239.5, "cy": 179.5}
    _write(tmp_path / "cam.yaml", camera | values | dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0))
    campaign = {
        "format": "robcal/campaign-1",
        "name": "station",
        "bodies": {"board": {"targets": "board.yaml"}},
        "station": {
            "cameras": {s: {"images": s, "calibration": "cam.yaml"} for s in ("left", "right")},
            "body": "board",
        },
    }
    _write(tmp_path / "campaign.yaml", campaign)
    done = run_campaign(tmp_path, tmp_path / "run", until="orient", workers=1)
    assert done.result["station"]["rms_px"] < 0.02
    stated = [yaml.safe_load((tmp_path / "run" / "cameras" / f"{s}.yaml").read_text()) for s in ("left", "right")]
    assert abs(stated[0]["fx"] - CAMERA.fx) < 1.0
    places = [np.array(s["world_T_camera"]["xyz_mm"]) for s in stated]
    assert abs(np.linalg.norm(places[1] - places[0]) - 200.0) < 0.2


def test_images_without_the_board_are_told(tmp_path: Path) -> None:
    other = BoardPattern("charuco", 7, 5, square=0.03, marker=0.022, dictionary="DICT_6X6_250")
    _photograph(tmp_path / "images", other, _views(other, 3, 1), ["a", "b", "c"])
    _body(tmp_path / "board.yaml", CHARUCO)
    campaign = {
        "format": "robcal/campaign-1",
        "name": "board",
        "bodies": {"board": {"targets": "board.yaml", "survey": {"images": "images"}}},
    }
    _write(tmp_path / "campaign.yaml", campaign)
    with pytest.raises(InvalidInput, match=r"no targets found in any of 3 images.*DICT_4X4_250.*were read"):
        run_campaign(tmp_path, tmp_path / "run", until="survey", workers=1)

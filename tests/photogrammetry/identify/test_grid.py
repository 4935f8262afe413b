"""Regular bodies of many uncoded dots among many false ones: rows, rivals, refusal; and a real recording."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from robcal.imaging.coarse_dots import coarse_dots
from robcal.imaging.detect import detect_targets
from robcal.imaging.settings import DetectionSettings
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera, project
from robcal.photogrammetry.identify.dots import Dots
from robcal.photogrammetry.identify.grid import congruences, has_rows, search_grid
from robcal.photogrammetry.identify.grow import refine_with_lens
from robcal.photogrammetry.identify.rows import body_rows, image_rows
from robcal.photogrammetry.station.identify import identify_station
from robcal.transforms import exp_so3, frame, transform

REAL = Path(__file__).resolve().parents[3] / "shared" / "real" / "openptv_cavity_4cam"
ROUGH = Camera(1280, 1024, 2000.0, 2000.0, 639.5, 511.5)
TRUE = Camera(1280, 1024, 2120.0, 2120.0, 645.0, 506.0, -0.1, 0.0, 5e-4, -5e-4)
FRONT = frame(exp_so3([0.25, -0.3, 0.2]), [0.0, 0.0, 0.35])
BEHIND = frame(exp_so3([0.2, 0.3, 0.1]) @ exp_so3([0.0, np.pi, 0.0]), [0.0, 0.0, 0.35])


def _steps(lopsided: bool) -> np.ndarray:
    """Five rows on three heights; ``lopsided``: one row is shorter at one end and one dot of another is missing."""
    rows = [(-0.05, 0.01, 15), (-0.03, 0.0, 14), (0.0, -0.01, 15), (0.03, 0.0, 15), (0.05, 0.01, 15)]
    points = [(0.008 * k - 0.056, y, z) for y, z, n in rows for k in range(n)]
    if lopsided:
        points = [p for k, p in enumerate(points) if k not in (3, 40, 41)]
    else:
        points += [(0.008 * 14 - 0.056, -0.03, 0.0)]
    return np.array(points)


def _dots(xy, size, contrast):
    return Dots(xy, np.zeros((len(xy), 2, 2)), np.column_stack([size, size]), contrast)


def _picture(body, pose, rng, *, false=500, hidden=0.0, noise=0.1):
    xy = project(TRUE, transform(pose, body.points)) + rng.normal(size=(len(body), 2)) * noise
    shown = rng.random(len(body)) >= hidden
    places = np.concatenate([xy[shown], rng.uniform([0, 0], [1280, 1024], (false, 2))])
    ids = np.concatenate([body.ids[shown], np.full(false, -1)])
    size = np.concatenate([np.full(shown.sum(), 4.0), np.exp(rng.normal(0.9, 0.5, false))])
    contrast = np.concatenate([rng.uniform(80, 120, shown.sum()), np.exp(rng.normal(4.2, 0.6, false))])
    order = rng.permutation(len(places))
    return _dots(places[order], size[order], contrast[order]), ids[order]


@pytest.mark.parametrize("pose", [FRONT, BEHIND])
def test_stepped_body_among_many_false_dots(pose):
    rng = np.random.default_rng(7)
    points = _steps(lopsided=True)
    body = Body("steps", np.arange(1, len(points) + 1), points)
    dots, ids = _picture(body, pose, rng, hidden=0.1)
    found, why = search_grid(ROUGH, dots, body.points, model_error_px=4.0)
    assert len(found) == 1, why
    best = found[0]
    true = ids[best.dots]
    assert np.mean(true == body.ids[best.targets]) > 0.97
    assert len(best.dots) >= 0.85 * len(body)


def test_symmetric_steps_are_refused():
    rng = np.random.default_rng(8)
    points = _steps(lopsided=False)
    body = Body("steps", np.arange(1, len(points) + 1), points)
    dots, _ = _picture(body, FRONT, rng, false=200)
    found, _ = search_grid(ROUGH, dots, body.points, model_error_px=4.0)
    assert len(found) == 2  # a half turn about z lays the body on itself


def test_false_dots_alone_are_refused():
    rng = np.random.default_rng(9)
    points = _steps(lopsided=True)
    body = Body("steps", np.arange(len(points)), points)
    dots, ids = _picture(body, FRONT, rng, false=900)
    keep = ids < 0
    found, why = search_grid(ROUGH, dots.select(keep), body.points, model_error_px=4.0)
    assert not found
    assert "row" in why


def test_rows_of_a_body():
    assert sorted(len(r) for r in body_rows(_steps(lopsided=False)) if len(r) > 10) == [15] * 5
    rng = np.random.default_rng(0)
    assert not has_rows(rng.uniform(size=(40, 3)))


def test_chain_follows_perspective_over_a_gap():
    rng = np.random.default_rng(1)
    s = np.delete(np.arange(14.0), 6)
    line = np.column_stack([100 + 50 * s / (1 + 0.01 * s), 300 + 9 * s / (1 + 0.01 * s)])
    xy = np.concatenate([line, rng.uniform(0, 1000, (150, 2))])
    chain = image_rows(_dots(xy, np.full(len(xy), 3.0), np.full(len(xy), 50.0)), longest_step=120.0)[0]
    own = chain[chain >= 0]
    assert set(range(13)) <= set(own.tolist())
    assert np.sum(chain < 0) >= 1


def test_congruences_of_a_grid():
    x, y = np.meshgrid(np.arange(5.0), np.arange(4.0))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(20)])
    motions = congruences(points, np.arange(20), share=0.99)
    assert len(motions) == 3  # half turns about x, y and z
    for T in motions:
        moved = transform(T, points)
        assert np.allclose(np.linalg.norm(moved[:, None] - points[None], axis=-1).min(axis=1), 0, atol=1e-9)


def test_refinement_recovers_pose_and_focal_length():
    points = _steps(lopsided=True)
    truth = Camera(1280, 1024, 2150.0, 2150.0, 639.5, 511.5, -0.05)
    xy = project(truth, transform(FRONT, points))
    pose, camera = refine_with_lens(ROUGH, ROUGH, FRONT, points, xy, scale=2.0, iterations=60)
    assert np.abs(project(camera, transform(pose, points)) - xy).max() < 0.3
    assert abs(camera.fx / 2150.0 - 1.0) < 0.05


def test_coarse_dots_of_unevenly_lit_balls():
    rng = np.random.default_rng(3)
    y, x = np.mgrid[0:200, 0:200]
    image = 20.0 + rng.normal(size=(200, 200)) * 2
    centres = rng.uniform(20, 180, (12, 2))
    keep = [k for k in range(12) if all(np.linalg.norm(centres[k] - centres[j]) > 25 for j in range(k))]
    for cx, cy in centres[keep]:
        r2 = ((x - cx) ** 2 + (y - cy) ** 2) / 4.5**2
        image += np.where(r2 < 1, 80 * np.sqrt(np.maximum(1 - r2, 0)) * (1 + 0.15 * (x - cx)), 0)
    xy, radius, _, _ = coarse_dots(np.clip(image, 0, 255).astype(np.uint8), 2.0)
    d = np.linalg.norm(centres[keep][:, None] - xy[None], axis=-1)
    assert np.all(d.min(axis=1) < 1.5)
    assert np.all(np.abs(radius[d.argmin(axis=1)] / 4.5 - 1) < 0.4)


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="the real recordings are not at hand")
def test_real_body_behind_glass_and_in_water():
    """All four cameras without clicked dots; the clicked ones must carry their numbers (whole pixels, by hand)."""
    listed = yaml.safe_load((REAL / "cavity_body.yaml").read_text(encoding="utf-8"))["targets"]
    body = Body("cavity", np.array([t["id"] for t in listed]), np.array([t["xyz_mm"] for t in listed]) / 1e3)
    camera = Camera(1280, 1024, 5833.3333, 5833.3333, 639.5, 511.5)
    settings = DetectionSettings(coarse=True)  # as the campaign's stage asks for
    names = ("cam1", "cam2", "cam3", "cam4")
    images = {n: cv2.imread(str(REAL / "station" / n / "p1.tif"), cv2.IMREAD_UNCHANGED) for n in names}
    detections = {n: {0: detect_targets(image, settings)} for n, image in images.items()}
    result = identify_station(detections, body, dict.fromkeys(names, camera))
    assert not result.problems
    clicked = [line.split(",") for line in (REAL / "origin" / "clicked.csv").read_text().splitlines()[1:]]
    for name, fewest in zip(names, (38, 38, 60, 60), strict=True):
        marks = result.marks[name]
        assert len(marks) >= fewest
        mine = [c for c in clicked if c[0] == name]
        seen = 0
        for _, target, x, y in mine:
            at = np.flatnonzero(marks.target == int(target))
            if len(at):
                seen += 1
                assert np.linalg.norm(marks.xy[at[0]] - [float(x), float(y)]) < 8.0
        assert seen >= 2

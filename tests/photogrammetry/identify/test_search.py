"""Search by triples of dots: the numbering of an irregular body, refusals with their reason, ambiguity of symmetric
ones."""

import numpy as np
import pytest

from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera, project
from robcal.photogrammetry.identify.dots import Dots, match_dots
from robcal.photogrammetry.identify.search import search_body
from robcal.transforms import Array, exp_so3, frame, transform

CAMERA = Camera(2400, 1800, 3200.0, 3200.0, 1200.0, 900.0)
POSE = frame(exp_so3([0.4, -0.3, 1.2]), [0.05, -0.1, 1.8])
POINTS = np.array(
    [[0, 0, 0], [0.3, 0.02, 0.03], [0.25, 0.28, 0], [-0.05, 0.22, 0.06], [0.12, 0.1, 0.1], [0.2, 0.16, 0]]
)


def _search(points: Array, extra: int = 0, candidates: Array | None = None) -> tuple:
    rng = np.random.default_rng(3)
    xy = project(CAMERA, transform(POSE, points)) + 0.05 * rng.normal(size=(len(points), 2))
    xy = np.concatenate([xy, rng.uniform([300, 200], [2100, 1600], (extra, 2))])
    order = rng.permutation(len(xy))
    body = Body("part", np.arange(len(points)) + 1, points)
    rows = np.arange(len(points)) if candidates is None else candidates
    covariance = np.tile(0.05**2 * np.eye(2), (len(xy), 1, 1))
    dots = Dots(xy[order], covariance, np.full((len(xy), 2), np.nan), np.ones(len(xy)))
    found = search_body(CAMERA, dots, body, rows, model_error_px=0.5)
    return (*found, order)


@pytest.mark.parametrize("extra", [0, 6])
def test_irregular_body_has_one_numbering(extra: int) -> None:
    found, _, order = _search(POINTS, extra)
    assert len(found) == 1
    assert order[found[0].rows].tolist() == found[0].targets.tolist()
    assert len(found[0].targets) == len(POINTS)
    np.testing.assert_allclose(found[0].camera_T_body, POSE, atol=2e-3)


def test_square_has_no_single_numbering() -> None:
    square = np.array([[0, 0, 0], [0.3, 0, 0], [0.3, 0.3, 0], [0, 0.3, 0]])
    found, _, _ = _search(square)
    assert len(found) != 1


@pytest.mark.parametrize(
    ("points", "candidates", "reason"),
    [(POINTS, np.arange(3), "four or more"), (np.outer(np.arange(5.0), [0.1, 0.01, 0.0]), np.arange(5), "one line")],
)
def test_too_little_for_geometry_is_refused(points: Array, candidates: Array, reason: str) -> None:
    found, why, _ = _search(points, candidates=candidates)
    assert found == []
    assert reason in why


def test_dots_are_matched_one_to_one() -> None:
    predicted = np.array([[10.0, 10.0], [20.0, 10.0], [np.nan, np.nan]])
    dots = np.array([[10.4, 10.0], [19.0, 10.0], [60.0, 60.0]])
    targets, found = match_dots(predicted, np.full(3, 3.0), dots, np.ones((3, 3), dtype=bool))
    assert targets.tolist() == [0, 1]
    assert found.tolist() == [0, 1]

"""What recurs in the lengths of a body: shifted and swapped targets, a common scale, and nothing where nothing is."""

import numpy as np
import pytest

from robcal.errors import DegenerateGeometry
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.measure.distance_criterion import make_pairs
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.photogrammetry.measure.recurring import Recurring, find_recurring, mean_shape
from robcal.photogrammetry.measure.unknown_body import body_from_points
from robcal.transforms import Array, fit_frame, retract, transform

POINTS = np.array([[0, 0, 0], [0.4, 0, 0.02], [0.4, 0.3, 0], [0, 0.3, 0.05], [0.2, 0.1, 0.08], [0.1, 0.22, -0.04]])
IDS = np.arange(11, 17)
SIGMA = 1e-5
POSES = 30


def _measured(points: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    T = [retract(np.eye(4), np.concatenate([rng.uniform(-1, 1, 3), rng.normal(size=3)])) for _ in range(POSES)]
    p = np.concatenate([transform(t, points) for t in T]) + SIGMA * rng.normal(size=(POSES * len(points), 3))
    return np.repeat(np.arange(POSES), len(points)), np.tile(np.arange(len(points)), POSES), p


def _recurring(true: Array, file: Array, seed: int) -> Recurring:
    pose, row, p = _measured(true, np.random.default_rng(seed))
    table = make_pairs(pose, row, p, np.tile(SIGMA**2 * np.eye(3), (len(p), 1, 1)))
    return find_recurring(Body("plate", IDS, file), table, pose, row, p, np.zeros(len(table)))


def test_nothing_recurs_in_a_true_body() -> None:
    found = _recurring(POINTS, POINTS, 1)
    assert (found.pairs, found.targets, found.scale_ppm) == ((), (), None)
    np.testing.assert_allclose(found.mean_points, POINTS, atol=5 * SIGMA)


def test_shifted_target_is_named_with_its_shift() -> None:
    true = POINTS.copy()
    true[4] += [3e-4, -2e-4, 1e-4]
    found = _recurring(true, POINTS, 2)
    assert found.shifted_ids == (15,)
    np.testing.assert_allclose(found.targets[0].shift, [3e-4, -2e-4, 1e-4], atol=3e-5)
    assert found.targets[0].swapped_with is None
    assert found.unexplained == ()


def test_swap_is_mutual() -> None:
    true = POINTS[[0, 1, 2, 3, 5, 4]]
    found = _recurring(true, POINTS, 3)
    assert {t.target: t.swapped_with for t in found.targets} == {15: 16, 16: 15}


def test_common_scale_is_no_shift_of_targets() -> None:
    found = _recurring(1.0005 * POINTS, POINTS, 4)
    assert found.scale_ppm == pytest.approx(500.0, abs=20.0)
    assert found.targets == ()


def test_mean_shape_ignores_gross_errors() -> None:
    pose, row, p = _measured(POINTS, np.random.default_rng(5))
    p[7] += 0.01
    mean, sigma, count = mean_shape(pose, row, p, POINTS)
    assert count.tolist() == [POSES] * 6
    assert np.abs(mean - POINTS).max() < 5 * SIGMA
    assert np.all(sigma < SIGMA)


def _points(pose: Array, row: Array, p: Array) -> MeasuredPoints:
    return MeasuredPoints(pose, IDS[row], p, None, np.zeros(len(p), dtype=np.int64), np.full(len(p), np.nan))


def test_unknown_body_has_its_own_shape_in_the_gram_schmidt_frame() -> None:
    pose, row, p = _measured(POINTS, np.random.default_rng(6))
    seen = (pose + row) % 5 != 0  # no pose shows all
    body = body_from_points(_points(pose[seen], row[seen], p[seen]), np.ones(int(seen.sum()), dtype=bool))
    assert body.ids.tolist() == IDS.tolist()
    moved = transform(fit_frame(POINTS, body.points), body.points)
    assert np.abs(moved - POINTS).max() < 5 * SIGMA
    on_axes = body.points[np.abs(body.points).max(axis=1) < 1e-12]
    assert len(on_axes) == 1  # the first target of the triangle is the origin


def test_line_of_targets_is_no_body() -> None:
    line = np.outer(np.arange(4.0), [0.1, 0, 0])
    pose, row, p = _measured(line, np.random.default_rng(7))
    with pytest.raises(DegenerateGeometry, match="line"):
        body_from_points(_points(pose, row, p), np.ones(len(p), dtype=bool))

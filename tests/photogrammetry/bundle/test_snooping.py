"""Reliability of marks against dense algebra; which marks the test takes out; variance factors."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.estimation.reliability import critical_value, mark_statistics, variance_factors, worst_marks
from robcal.photogrammetry.bundle.adjustment import adjust
from robcal.photogrammetry.bundle.covariance import cofactors, factorise
from robcal.photogrammetry.bundle.normals import Linearised
from robcal.photogrammetry.bundle.operator import problem_of
from robcal.photogrammetry.bundle.settings import AdjustSettings
from robcal.photogrammetry.bundle.snooping import reliability
from robcal.photogrammetry.core.network import CameraNetwork, ImageMarks
from robcal.transforms import Array
from tests.photogrammetry.networks import Truth, make_network

_FREE = ("fx", "fy", "cx", "cy", "k1")


def _adjusted(truth: Truth, marks: ImageMarks, **settings: object) -> CameraNetwork:
    options = AdjustSettings(**settings)  # type: ignore[arg-type]
    return adjust(marks, truth.camera, truth.camera_T_body, truth.points, free_intrinsics=_FREE, settings=options)


def _dense(lin: Linearised, marks: ImageMarks, targets: int, images: int) -> Array:
    """(2m, k + 3t + 6n) Jacobian."""
    k, m = lin.k, len(marks)
    J = np.zeros((m, 2, k + 3 * targets + 6 * images))
    J[:, :, :k] = lin.J[:, :, :k]
    for i in range(m):
        at, after = k + 3 * marks.target[i], k + 3 * targets + 6 * marks.image[i]
        J[i, :, at : at + 3] = lin.J[i, :, k : k + 3]
        J[i, :, after : after + 6] = lin.J[i, :, k + 3 :]
    return J.reshape(2 * m, -1)


def test_residual_cofactors_are_those_of_the_dense_adjustment() -> None:
    truth = make_network(np.random.default_rng(1), images=6, targets=12)
    problem, state = problem_of(_adjusted(truth, truth.marks, snooping=False, variance_components=False))
    lin, factor = factorise(problem, state)
    rel = reliability(lin, problem.order, factor, cofactors(problem, state, factor), problem.weights)
    J = _dense(lin, problem.order.marks, problem.order.targets, problem.order.images)
    J = J * np.repeat(np.sqrt(problem.weights), 2)[:, None]
    left = np.linalg.svd(J, full_matrices=False)[0][:, : J.shape[1] - 7]  # images leave seven freedoms
    R = np.eye(len(J)) - left @ left.T
    m = len(problem.order.marks)
    blocks = R.reshape(m, 2, m, 2)[np.arange(m), :, np.arange(m), :]
    np.testing.assert_allclose(rel.residual_cofactor, blocks, atol=1e-6)
    assert rel.share.sum() == pytest.approx(len(J) - (J.shape[1] - 7), abs=1e-5)


def test_planted_gross_errors_are_taken_out_and_nothing_else() -> None:
    rng = np.random.default_rng(2)
    truth = make_network(rng, images=8, targets=20)
    bad = rng.choice(len(truth.marks), 4, replace=False)
    xy = truth.marks.xy.copy()
    xy[bad] += 20.0 * truth.sigma * np.array([0.6, 0.8])
    network = _adjusted(truth, replace(truth.marks, xy=xy))
    planted = {(str(truth.marks.image[i]), int(truth.marks.target[i])) for i in bad}
    assert {(mark.image, mark.target) for mark in network.rejected} == planted
    assert all(mark.statistic > critical_value(len(truth.marks), 1e-5) for mark in network.rejected)


def test_statistic_of_a_fully_redundant_mark_is_its_squared_length() -> None:
    truth = make_network(np.random.default_rng(3), images=6, targets=12)
    problem, state = problem_of(_adjusted(truth, truth.marks))
    lin, factor = factorise(problem, state)
    rel = reliability(lin, problem.order, factor, cofactors(problem, state, factor), problem.weights)
    full = replace(rel, residual_cofactor=np.tile(np.eye(2), (3, 1, 1)))
    r = np.array([[3.0, 4.0], [0.0, 0.0], [1.0, -1.0]])
    np.testing.assert_allclose(mark_statistics(r, full.residual_cofactor), [25.0, 0.0, 2.0])
    none = replace(rel, residual_cofactor=np.zeros((3, 2, 2)))
    np.testing.assert_array_equal(mark_statistics(r, none.residual_cofactor), 0.0)


def test_one_mark_of_an_image_and_of_a_target_at_a_time() -> None:
    statistic = np.array([50.0, 40.0, 45.0, 5.0, 30.0])
    image, target = np.array([0, 0, 1, 2, 2]), np.array([0, 1, 0, 3, 4])
    # rows 1 and 2 share the image or the target of the worst one; row 3 is not significant
    assert worst_marks(statistic, 20.0, image, target).tolist() == [0, 4]
    assert len(worst_marks(statistic, 100.0, image, target)) == 0


def test_variance_factors_are_squares_by_redundancies() -> None:
    rng = np.random.default_rng(4)
    group = np.repeat([0, 1], 4000)
    r = rng.normal(size=(8000, 2)) * np.array([1.0, 3.0])[group][:, None]
    factors = variance_factors(r, np.full(8000, 2.0), group, 3)
    np.testing.assert_allclose(factors[:2], [1.0, 9.0], rtol=0.05)
    assert np.isnan(factors[2])

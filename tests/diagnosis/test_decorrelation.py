"""Whitening of errors that the rows of a pose share."""

import numpy as np

from robcal.diagnosis.core.decorrelation import CommonNoise, SharedNoise


def test_shared_errors_become_white_and_come_back() -> None:
    rng = np.random.default_rng(0)
    pose = np.array([0, 1, 0, 1, 2])
    moved = rng.normal(size=(5, 3, 2))
    shared = SharedNoise(pose, moved, 2.5)
    A = np.zeros((15, 6))
    for i, p in enumerate(pose):
        A[3 * i : 3 * i + 3, 2 * p : 2 * p + 2] = moved[i]
    covariance = np.eye(15) + 2.5 * A @ A.T
    W = shared.whiten(np.eye(15))
    assert np.allclose(W @ covariance @ W.T, np.eye(15), atol=1e-10)
    assert np.isclose(shared.log_determinant, np.linalg.slogdet(covariance)[1])
    x = rng.normal(size=(15, 4))
    assert np.allclose(shared.unwhiten(shared.whiten(x)), x)


def test_estimate_and_local_part_of_common_errors() -> None:
    rng = np.random.default_rng(8)
    columns = rng.normal(0, 3.0, (200, 4))
    common = CommonNoise(columns)
    errors = rng.standard_normal(4)
    plain = columns @ errors + rng.standard_normal(200)
    white = common.whiten(plain)
    assert np.allclose(common.estimate(white), errors, atol=0.15)
    # whitening twice applies the inverse covariance: what is left once the estimated errors are taken off
    assert np.allclose(common.whiten(white), plain - columns @ common.estimate(white))

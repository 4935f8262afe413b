"""Compiled sums over marks against dense least squares."""

import numpy as np
import pytest

from robcal.photogrammetry.station.adjustment_loops import Blocks, Places, Sums, add_marks, covariances

pytestmark = pytest.mark.unit

E, C, T, P, M = 3, 2, 4, 5, 60
G = 6 * E + 9 * C + 3 * T


def marks(seed: int = 1) -> tuple[Blocks, Places, np.ndarray, np.ndarray]:
    """Random derivatives, with the dense Jacobian (m, 2, G + 6 P) that they stand for, and weights."""
    rng = np.random.default_rng(seed)
    blocks = Blocks(*(rng.normal(size=shape) for shape in ((M, 2), (M, 2, 6), (M, 2, 9), (M, 2, 3), (M, 2, 6))))
    exterior = rng.integers(0, E, M)
    places = Places(exterior, np.minimum(exterior, C - 1), rng.integers(0, T, M), rng.integers(0, P, M), E, C)
    dense = np.zeros((M, 2, G + 6 * P))
    for i in range(M):
        first, second = 6 * places.exterior[i], 6 * E + 9 * places.camera[i]
        third, fourth = 6 * E + 9 * C + 3 * places.target[i], G + 6 * places.pose[i]
        dense[i, :, first : first + 6], dense[i, :, second : second + 9] = blocks.exterior[i], blocks.interior[i]
        dense[i, :, third : third + 3], dense[i, :, fourth : fourth + 6] = blocks.point[i], blocks.pose[i]
    return blocks, places, dense, rng.uniform(0.0, 2.0, M)


def test_normal_equations_are_the_dense_ones() -> None:
    blocks, places, dense, weights = marks()
    sums = Sums(np.zeros((G, G)), np.zeros(G), np.zeros((G, P, 6)), np.zeros((P, 6, 6)), np.zeros((P, 6)))
    add_marks(blocks, places, weights, sums)
    normal = np.einsum("mki,m,mkj->ij", dense, weights, dense)
    right = np.einsum("mki,m,mk->i", dense, weights, blocks.residual)
    np.testing.assert_allclose(np.tril(sums.matrix), np.tril(normal[:G, :G]), atol=1e-11)
    np.testing.assert_allclose(sums.coupling.reshape(G, -1), normal[:G, G:], atol=1e-11)
    np.testing.assert_allclose(np.concatenate([sums.right, sums.pose_right.ravel()]), right, atol=1e-11)
    for p in range(P):
        at = slice(G + 6 * p, G + 6 * p + 6)
        np.testing.assert_allclose(sums.pose_matrix[p], normal[at, at], atol=1e-11)


def test_covariances_are_the_dense_ones() -> None:
    blocks, places, dense, _ = marks(2)
    root = np.random.default_rng(3).normal(size=(G + 6 * P, G + 6 * P))
    Q = root @ root.T
    Qgp = np.ascontiguousarray(Q[:G, G:].reshape(G, P, 6).transpose(1, 0, 2))
    Qpp = np.array([Q[G + 6 * p : G + 6 * p + 6, G + 6 * p : G + 6 * p + 6] for p in range(P)])
    out = np.empty((M, 2, 2))
    covariances(blocks, places, Q[:G, :G].copy(), Qgp, Qpp, out)
    np.testing.assert_allclose(out, np.einsum("mki,ij,mnj->mkn", dense, Q, dense), rtol=1e-9, atol=1e-9)

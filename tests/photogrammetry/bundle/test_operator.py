"""A finished network as an operator: projection, tests of effects that were left out."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.photogrammetry.bundle.adjustment import AdjustSettings, adjust
from robcal.photogrammetry.bundle.operator import NetworkOperator
from robcal.photogrammetry.core.camera import normalise, project_with_jacobians
from robcal.photogrammetry.core.network import CameraNetwork, Lengths
from robcal.transforms import transform
from tests.photogrammetry.networks import make_network

PINHOLE = ("fx", "fy", "cx", "cy")
QUIET = AdjustSettings(robust=False, snooping=False, variance_components=False)


def network(distortion: tuple[float, ...], seed: int = 0) -> CameraNetwork:
    truth = make_network(np.random.default_rng(seed), images=12, targets=20, distortion=distortion)
    start = truth.camera.with_vector([*truth.camera.vector[:4], 0, 0, 0, 0, 0])
    return adjust(truth.marks, start, truth.camera_T_body, truth.points, free_intrinsics=PINHOLE, settings=QUIET)


def lens_columns(net: CameraNetwork) -> np.ndarray:
    p = transform(net.camera_T_body[net.marks.image], net.points[net.marks.target])
    return project_with_jacobians(net.camera, p)[2][:, :, 4:]


def test_projection_laws() -> None:
    net = network((0.0,) * 5)
    operator = NetworkOperator(net)
    columns = operator.whiten(lens_columns(net))
    once = operator.project_out(columns)
    np.testing.assert_allclose(operator.project_out(once), once, atol=1e-6 * np.abs(columns).max())
    # residuals at the minimum are what remains already
    np.testing.assert_allclose(operator.project_out(operator.residuals[:, None])[:, 0], operator.residuals, atol=1e-3)
    # what the network's own unknowns can do vanishes
    fx = np.zeros((len(net.marks), 2, 1))
    fx[:, 0, 0] = normalise(net.camera, net.marks.xy)[:, 0]
    whitened = operator.whiten(fx)
    assert np.linalg.norm(operator.project_out(whitened)) < 0.02 * np.linalg.norm(whitened)
    # a dense projection says the same
    m, k = len(net.marks), operator.lin.k
    dense = np.zeros((m, 2, k + 3 * len(net.ids) + 6 * len(net.image_names)))
    for row, (i, j) in enumerate(zip(net.marks.image, net.marks.target, strict=True)):
        dense[row, :, :k] = operator.J[row, :, :k]
        dense[row, :, k + 3 * j : k + 3 * j + 3] = operator.J[row, :, k : k + 3]
        at = k + 3 * len(net.ids) + 6 * i
        dense[row, :, at : at + 6] = operator.J[row, :, k + 3 :]
    U, s, _ = np.linalg.svd(dense.reshape(2 * m, -1), full_matrices=False)
    U = U[:, s > 1e-9 * s[0]]
    np.testing.assert_allclose(once, columns - U @ (U.T @ columns), atol=1e-5 * np.abs(columns).max())


def test_a_missing_lens_term_is_seen_and_estimated() -> None:
    net = network((-0.01, 0.0, 0.0, 0.0, 0.0))
    test = NetworkOperator(net).test(lens_columns(net)[:, :, :1])
    assert test.p_value < 1e-6
    assert abs(test.estimate[0] + 0.01) < 5 * np.sqrt(test.covariance[0, 0]) + 1e-3


def test_nothing_missing_is_not_significant() -> None:
    values = []
    for seed in range(12):
        net = network((0.0,) * 5, seed)
        values.append(NetworkOperator(net).test(lens_columns(net)).p_value)
    assert min(values) > 1e-4
    assert max(values) > 0.2


def test_scale_bars_take_part() -> None:
    truth = make_network(np.random.default_rng(3), images=10, targets=16)
    bar = Lengths([[0, 15]], [float(np.linalg.norm(truth.points[0] - truth.points[15]))], [1e-5])
    net = adjust(truth.marks, truth.camera, truth.camera_T_body, truth.points, lengths=bar)
    operator = NetworkOperator(net, bar)
    assert operator.problem.datum.defect == 6
    column = operator.whiten(np.random.default_rng(0).normal(size=(len(net.marks), 2)))
    assert operator.project_out(column).shape == column.shape
    with pytest.raises(InvalidInput, match="columns need shape"):
        operator.whiten(np.zeros((3, 2)))
    fixed = adjust(truth.marks, truth.camera, truth.camera_T_body, truth.points, datum=(0, 3, 12))
    assert NetworkOperator(replace(fixed)).problem.datum.kind == "fixed"

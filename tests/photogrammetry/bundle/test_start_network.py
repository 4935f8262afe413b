"""Approximate networks and single resections from identified points."""

import numpy as np
import pytest

from robcal.errors import DegenerateGeometry
from robcal.photogrammetry.bundle.start_network import approximate_network
from robcal.photogrammetry.core.camera import Camera, project
from robcal.photogrammetry.core.network import ImageMarks
from robcal.photogrammetry.orientation.robust_pose import robust_pose
from robcal.photogrammetry.orientation.start_planar import best_references, planar_starts, plane_share
from robcal.transforms import difference, transform
from tests.photogrammetry.networks import make_network


@pytest.mark.parametrize("body", ["plate", "sphere"])
def test_resection_with_wrong_ids(body: str) -> None:
    rng = np.random.default_rng(0)
    truth = make_network(rng, body, images=6, targets=30 if body == "plate" else 60, distortion=(0.0,) * 5)
    for j in range(6):
        rows = np.flatnonzero(truth.marks.image == j)[:10]
        X, xy = truth.points[truth.marks.target[rows]], truth.marks.xy[rows].copy()
        xy[:2] = xy[1::-1] + np.array([40.0, -60.0])
        found = robust_pose(truth.camera, X, xy, 1.0)
        assert found is not None
        assert found.inliers.tolist() == [False] * 2 + [True] * (len(rows) - 2)
        d = difference(truth.camera_T_body[j], found.camera_T_body)
        assert np.linalg.norm(d[3:]) < 5e-3
    assert robust_pose(truth.camera, X[:3], xy[:3], 1.0) is None
    assert robust_pose(truth.camera, X, rng.uniform(0, 1800, xy.shape), 1.0) is None


def test_planar_self_calibration_finds_focal_length_and_shape() -> None:
    for factor in (0.8, 1.5, 3.0):
        rng = np.random.default_rng(int(10 * factor))
        truth = make_network(rng, images=10, targets=20, focal_factor=factor, distortion=(0.0,) * 5)
        camera = Camera.from_size(2400, 1800)
        reference = int(best_references(truth.marks, 10, 20)[0])
        assert plane_share(truth.marks, reference, 20, 2400) > 0.9
        start = planar_starts(truth.marks, reference, 20, camera, focal_known=False)[0]
        assert abs(start.focal / truth.camera.fx - 1.0) < 0.1
        a, b = start.points - start.points.mean(axis=0), truth.points - truth.points.mean(axis=0)
        ratio = np.linalg.norm(a[:, None] - a[None], axis=2) / np.maximum(
            np.linalg.norm(b[:, None] - b[None], axis=2), 1e-9
        )
        off = ratio[~np.eye(20, dtype=bool)]
        assert np.std(off) / np.mean(off) < 0.05
    sphere = make_network(np.random.default_rng(3), "sphere", images=30, targets=80)
    reference = int(best_references(sphere.marks, 30, 80)[0])
    assert plane_share(sphere.marks, reference, 80, 2400) < 0.8


@pytest.mark.parametrize(("body", "known"), [("plate", True), ("plate", False), ("sphere", True), ("sphere", False)])
def test_networks_with_known_and_unknown_coordinates(body: str, known: bool) -> None:
    rng = np.random.default_rng(4)
    truth = make_network(rng, body, images=20, targets=20 if body == "plate" else 50)
    given = None
    if known:
        given = np.full_like(truth.points, np.nan)
        given[::2] = truth.points[::2] + rng.normal(0, 1e-3, truth.points[::2].shape)
    start = approximate_network(
        truth.marks, 20, len(truth.points), Camera.from_size(2400, 1800), focal_known=False, known_points=given
    )
    assert start.placed.mean() > 0.8
    assert abs(start.camera.fx / truth.camera.fx - 1.0) < 0.02
    rows = np.flatnonzero(start.fits)
    T, X = start.camera_T_body[truth.marks.image[rows]], start.points[truth.marks.target[rows]]
    miss = np.linalg.norm(project(start.camera, transform(T, X)) - truth.marks.xy[rows], axis=1)
    assert np.median(miss) < 0.5


def test_images_of_nothing_in_common() -> None:
    rng = np.random.default_rng(5)
    m = 24
    marks = ImageMarks(
        np.repeat(np.arange(4), 6), np.arange(m), rng.uniform(0, 1500, (m, 2)), np.tile(np.eye(2), (m, 1, 1))
    )
    with pytest.raises(DegenerateGeometry, match="six coded targets"):
        approximate_network(marks, 4, m, Camera.from_size(2400, 1800), focal_known=False)

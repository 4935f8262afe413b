"""COLMAP at the edge: pixel convention, export and back."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from robcal.errors import InvalidInput
from robcal.photogrammetry.bundle.adjustment import adjust
from robcal.photogrammetry.bundle.colmap_engine import adjust_with_colmap, export_colmap
from tests.photogrammetry.networks import make_network


def test_exported_model_projects_onto_the_same_pixels(tmp_path: Path) -> None:
    truth = make_network(np.random.default_rng(0), images=6, targets=12)
    net = adjust(
        truth.marks, truth.camera, truth.camera_T_body, truth.points, image_names=[f"i{j}.png" for j in range(6)]
    )
    export_colmap(net, tmp_path)
    assert {"cameras.txt", "images.txt", "points3D.txt"} <= {f.name for f in tmp_path.iterdir()}
    model = pycolmap.Reconstruction(tmp_path)
    assert model.num_images() == 6
    assert model.num_points3D() == 12
    for image in model.images.values():
        rows = net.marks.image == net.image_names.index(image.name)
        keypoints = np.array([p.xy for p in image.points2D])
        np.testing.assert_allclose(keypoints, net.marks.xy[rows] + 0.5, atol=1e-6)
        for point, residual in zip(image.points2D, net.residuals[rows], strict=True):
            projected = image.project_point(model.points3D[point.point3D_id].xyz)
            np.testing.assert_allclose(point.xy - projected, residual, atol=1e-5)


def test_engine_refuses_what_it_cannot_hold() -> None:
    truth = make_network(np.random.default_rng(1), images=6, targets=12)
    net = adjust(truth.marks, truth.camera, truth.camera_T_body, truth.points, free_intrinsics=("fx", "fy", "k1"))
    with pytest.raises(InvalidInput, match="engine robcal"):
        adjust_with_colmap(net)

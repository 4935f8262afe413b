"""Which targets a camera sees, and the information of what it sees against a least-squares solution."""

import numpy as np
import pytest

from robcal.calibration.collision import PlacedCapsules
from robcal.calibration.visibility import (
    Viewpoint,
    VisibilityRules,
    frame_information,
    measurable,
    seen_targets,
    target_normals,
)
from robcal.errors import InvalidInput
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera, project
from robcal.transforms import frame_from_xyzrpy, invert, retract, transform

CAMERA = Camera(2000, 1500, 3000.0, 3000.0, 999.5, 749.5, k1=-0.1)
PLATE = Body(
    "plate",
    np.arange(5),
    np.array([[-0.2, -0.2, 0], [0.2, -0.2, 0], [0.2, 0.2, 0], [-0.2, 0.2, 0], [0, 0, 0]]),
    diameters=np.full(5, 0.012),
)
RULES = VisibilityRules(cameras=1)
FRONT = Viewpoint("front", CAMERA, np.eye(4))


def plate_at(z: float, turn: float = 0.0, x: float = 0.0) -> np.ndarray:
    """Plate in front of a camera in the origin, facing it when turn is zero."""
    return frame_from_xyzrpy([x, 0.0, z, 0.0, np.pi - turn, 0.0])[None]


def test_plate_facing_the_camera_is_seen_whole():
    seen = seen_targets(plate_at(3.0), PLATE, [FRONT], RULES)
    assert seen.shape == (1, 1, 5)
    assert seen.all()
    assert measurable(seen, RULES).all()
    assert not measurable(seen, VisibilityRules(cameras=2)).any()


@pytest.mark.parametrize(
    "T", [plate_at(3.0, turn=np.deg2rad(65)), plate_at(3.0, turn=np.pi), plate_at(-3.0), plate_at(12.0), plate_at(0.5)]
)
def test_turned_hidden_behind_far_and_too_near_plates_are_not(T):
    assert not measurable(seen_targets(T, PLATE, [FRONT], RULES), RULES).any()


def test_only_the_part_inside_the_image_counts():
    seen = seen_targets(plate_at(2.0, x=0.62), PLATE, [FRONT], RULES)[0, 0]
    assert 0 < seen.sum() < 5


def test_link_in_the_line_of_sight_hides_targets():
    def capsule(x: float) -> PlacedCapsules:
        start, end = np.array([[[x, -1.0, 1.5]]]), np.array([[[x, 1.0, 1.5]]])
        return PlacedCapsules(start, end, np.array([0.03]), np.array([0]))

    assert seen_targets(plate_at(3.0), PLATE, [FRONT], RULES, capsule(0.3)).all()
    middle = seen_targets(plate_at(3.0), PLATE, [FRONT], RULES, capsule(0.0))[0, 0]
    assert middle.tolist() == [True, True, True, True, False]
    side = seen_targets(plate_at(3.0), PLATE, [FRONT], RULES, capsule(0.1))[0, 0]
    assert side.sum() == 3


def test_sphere_shows_the_side_that_faces():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ball = Body("ball", np.arange(40), 0.2 * directions)
    assert target_normals(ball) == pytest.approx(directions, abs=1e-9)
    seen = seen_targets(plate_at(3.0), ball, [FRONT], VisibilityRules(cameras=1, incidence=np.deg2rad(50)))[0, 0]
    towards = -(plate_at(3.0)[0, :3, :3] @ directions.T).T[:, 2]
    assert np.all(towards[seen] > 0.5)
    assert seen.sum() > 3


def test_information_predicts_the_scatter_of_an_adjusted_frame():
    """Against the normal matrix by differences of the projection itself."""
    second = Viewpoint("side", CAMERA, frame_from_xyzrpy([1.5, 0.0, 0.2, 0.0, -0.45, 0.0]))
    T = plate_at(3.0, turn=0.2)
    views = [FRONT, second]
    seen = seen_targets(T, PLATE, views, RULES)
    seen[0, 1, 2] = False
    information = frame_information(T, PLATE, views, seen, 0.05)[0]

    def pixels(delta: np.ndarray) -> np.ndarray:
        p = transform(retract(T[0], delta), PLATE.points)
        return np.concatenate(
            [project(CAMERA, transform(invert(v.world_T_camera), p[seen[0, k]])).ravel() for k, v in enumerate(views)]
        )

    h = 1e-6
    J = np.column_stack([(pixels(h * e) - pixels(-h * e)) / (2 * h) for e in np.eye(6)])
    assert information == pytest.approx(J.T @ J / 0.05**2, rel=1e-6)


def test_missing_cameras_and_coordinates_are_told():
    with pytest.raises(InvalidInput, match="no camera"):
        seen_targets(plate_at(3.0), PLATE, [], RULES)
    with pytest.raises(InvalidInput, match="survey it first"):
        seen_targets(plate_at(3.0), Body("new", np.arange(3), np.full((3, 3), np.nan)), [FRONT], RULES)

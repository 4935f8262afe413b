"""Units and mirror images are told from points alone; healthy points raise no suspicion."""

import numpy as np
import pytest

from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.measure.point_faults import length_ratio, mirrored, unit_fault
from robcal.transforms import frame_from_xyzrpy, transform


def _points(plane: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray, Body]:
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.2, 0.2, (6, 3)) * ([1, 1, 0] if plane else [1, 1, 1])
    ids = np.array([9, 4, 30, 2, 17, 8])
    frames = frame_from_xyzrpy(np.column_stack([rng.normal(0, 1, (12, 3)), rng.uniform(-3, 3, (12, 3))]))
    p = np.concatenate([transform(T, points) for T in frames]) + rng.normal(0, 5e-5, (72, 3))
    return np.repeat(np.arange(12), 6), np.tile(ids, 12), p, Body("plate", ids, points)


def test_healthy_points() -> None:
    pose, target, p, body = _points()
    ratio = length_ratio(pose, target, p, body)
    assert ratio == pytest.approx(1.0, abs=1e-3)
    assert not unit_fault(ratio)
    assert mirrored(pose, target, p, body) is None


@pytest.mark.parametrize("factor", [1e-3, 25.4, 0.1])
def test_units(factor: float) -> None:
    pose, target, p, body = _points()
    assert unit_fault(length_ratio(pose, target, factor * p, body))


@pytest.mark.parametrize("order", [[1, 0, 2], [0, 2, 1], [2, 1, 0]])
def test_exchanged_coordinates(order: list[int]) -> None:
    pose, target, p, body = _points()
    found = mirrored(pose, target, p[:, order], body)
    assert found is not None
    assert found[1] < 1e-3 < found[0]


def test_wrong_sign_and_cyclic_exchange() -> None:
    pose, target, p, body = _points()
    assert mirrored(pose, target, p * [1, -1, 1], body) is not None
    assert mirrored(pose, target, p[:, [1, 2, 0]], body) is None  # only another name for the axes


def test_plane_body_leaves_the_mirror_open() -> None:
    pose, target, p, body = _points(plane=True)
    assert mirrored(pose, target, p[:, [1, 0, 2]], body) is None


def test_unknown_targets_are_left_out() -> None:
    pose, target, p, body = _points()
    alone = Body("plate", body.ids, np.where(body.ids[:, None] == 9, body.points, np.nan))
    assert length_ratio(pose, target, p, alone) is None
    assert length_ratio(pose, np.full_like(target, 999), p, body) is None

"""Slips in the recording are named, with the proof; a healthy recording raises no suspicion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robcal.calibration.observations import Observations, PointObservations
from robcal.calibration.plausibility import likely_causes, outside_limits
from robcal.robot.kernel import Kernel
from robcal.robot.model import Frame
from robcal.transforms import frame_from_xyzrpy, xyzrpy_from_frame
from tests.calibration.scenarios import Scenario, scenario
from tests.robot.chains import kr_like


def _observed(s: Scenario, kind: str) -> list[Observations]:
    frames = s.frames(s.poses)
    if kind == "frames":
        return [frames]
    n = len(s.poses)
    C = np.broadcast_to(25e-10 * np.eye(3), (n, 3, 3))
    return [PointObservations(frames.pose, np.zeros((n, 3)), frames.world_T_tool[:, :3, 3], C, np.zeros(n))]


def _damage(q: np.ndarray, what: str) -> np.ndarray:
    out = q.copy()
    if what == "sign":
        out[:, 2] *= -1
    elif what == "exchange":
        out[:, [1, 3]] = q[:, [3, 1]]
    elif what == "slip":
        out = np.roll(q, 1, axis=0)
    elif what == "late slip":
        out[40:] = np.roll(q[40:], 1, axis=0)
    elif what == "radians":
        out = np.deg2rad(q)
    elif what == "degrees":
        out = np.rad2deg(q)
    return out


EXPECTED = {
    "sign": ("wrong_sign", "axis3"),
    "exchange": ("exchanged_columns", "axis2 and axis4"),
    "slip": ("slipped_rows", "all rows"),
    "late slip": ("slipped_rows", "from row 41"),
    "radians": ("wrong_unit", "all joints"),
    "degrees": ("wrong_unit", "all joints"),
}


@pytest.mark.parametrize("what", EXPECTED)
@pytest.mark.parametrize("kind", ["frames", "points"])
def test_slip_is_named(what: str, kind: str) -> None:
    s = scenario(11)
    observed = _observed(s, kind)
    causes = likely_causes(s.model, s.poses.with_q(_damage(s.poses.q, what)), observed, s.kernel)
    assert (causes[0].kind, causes[0].where) == EXPECTED[what]
    assert causes[0].rms_after < 0.25 * causes[0].rms_before
    assert "mending" in causes[0].statement


def test_health_raises_no_suspicion_and_chaos_no_false_cause() -> None:
    s = scenario(12)
    assert likely_causes(s.model, s.poses, _observed(s, "frames"), s.kernel) == []
    chaos = s.poses.with_q(s.rng.permutation(s.poses.q))
    assert likely_causes(s.model, chaos, _observed(s, "frames"), s.kernel) == []


def test_limits() -> None:
    frames = kr_like().frames
    model = kr_like(frames=(replace(frames[0], limits=(-1.0, 1.0)), *frames[1:]))
    kernel = Kernel(model)
    assert outside_limits(model, kernel.poses([[0.5] * 6, [1.5] + [0.0] * 5])) == [(1, "axis1", 1.5)]
    assert isinstance(frames[0], Frame)


def _read_wrongly(six: np.ndarray, what: str) -> np.ndarray:
    out = six.copy()
    if what == "x and y":
        out[:, [0, 1]] = six[:, [1, 0]]
    elif what == "roll and yaw":
        out[:, [3, 5]] = six[:, [5, 3]]
    elif what == "z has the wrong sign":
        out[:, 2] *= -1
    elif what == "radians":
        out[:, 3:] = np.deg2rad(six[:, 3:])
    return out


@pytest.mark.parametrize("what", ["x and y", "roll and yaw", "z has the wrong sign", "radians"])
def test_columns_of_measured_frames(what: str) -> None:
    s = scenario(11)
    frames = s.frames(s.poses)
    six = _read_wrongly(xyzrpy_from_frame(frames.world_T_tool), what)
    causes = likely_causes(s.model, s.poses, [replace(frames, world_T_tool=frame_from_xyzrpy(six))], s.kernel)
    assert causes[0].kind == ("measured_unit" if what == "radians" else "measured_columns")
    assert what in causes[0].statement


def test_mirrored_points() -> None:
    s = scenario(11)
    (points,) = _observed(s, "points")
    assert isinstance(points, PointObservations)
    causes = likely_causes(s.model, s.poses, [replace(points, p_world=points.p_world[:, [1, 0, 2]])], s.kernel)
    assert causes[0].kind == "measured_columns"

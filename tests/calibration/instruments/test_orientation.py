"""The orientation of a sensor in the hand: held as certified, unless its points tell it."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.calibration.instruments import CellFrame, Instrument
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import RobotRecording
from robcal.calibration.observations import SensorPointObservations
from robcal.recipe.instruments import with_determined_orientations
from robcal.robot.kernel import Kernel
from robcal.transforms import Array, frame_from_xyzrpy, transform, xyzrpy_from_frame
from tests.robot.chains import kr_like

WORLD, TOOL = frame_from_xyzrpy([-1.3, 0.1, -0.8, 0.1, 0.2, 0.3]), frame_from_xyzrpy([0.05, 0.0, 0.3, 0.1, 0.2, 0.3])


def eye(width: float, angles: Array) -> tuple[Kernel, JointLog, Instrument]:
    """40 poses of which each sees eight targets up to ``width`` (m) beside the line of sight, 0.2 m away."""
    kernel, rng = Kernel(kr_like()), np.random.default_rng(1)
    q = rng.uniform(-1.0, 1.0, (40, 6))
    T = kernel.with_references(WORLD, TOOL).frames(kernel.theta0, kernel.poses(q))
    x = np.array([0, 0, 0.2]) + rng.uniform(-width, width, (40, 8, 3))
    pose = np.repeat(np.arange(40), 8)
    seen = x.reshape(-1, 3) + 2e-5 * rng.standard_normal((320, 3))
    o = SensorPointObservations(
        pose, seen, transform(T[pose], x.reshape(-1, 3)), np.tile(4e-10 * np.eye(3), (320, 1, 1))
    )
    given = xyzrpy_from_frame(TOOL)
    given[3:] = angles
    tool = CellFrame("eye", "tool", tuple(given.tolist()), (np.inf,) * 3 + (0.0,) * 3, certified=True)
    log = JointLog(tuple(f"p{k}" for k in range(40)), q, (None,) * 40, np.zeros(40, bool), np.zeros((40, 6)))
    return kernel, log, Instrument("eye", RobotRecording((o,), (o,), True), CellFrame("eye", "base"), tool)


@pytest.mark.parametrize(("width", "told"), [(0.003, False), (0.12, True)])
def test_a_wide_view_tells_the_orientation_a_narrow_one_does_not(width: float, told: bool) -> None:
    kernel, log, instrument = eye(width, xyzrpy_from_frame(TOOL)[3:])
    (out,), (note,) = with_determined_orientations(kernel, log, [instrument])
    assert (out.tool.sigma[3] == np.inf) == told
    assert ("is identified" in note) == told
    assert "eye" in note


def test_what_is_stated_otherwise_stays_as_it_is() -> None:
    kernel, log, instrument = eye(0.12, xyzrpy_from_frame(TOOL)[3:])
    plain = replace(instrument, tool=replace(instrument.tool, certified=False))
    assert with_determined_orientations(kernel, log, [plain]) == ([plain], [])

"""`calibration.conf` of Universal Robots: deviations added to the nominal table beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.files.robot_import import read_any_robot
from robcal.robot.kernel import Kernel

MOUNTING = """[mounting]
delta_theta = [ 1e-7, -0.3, 0.25, 0.05, 1e-4, -2e-5] # rad
delta_a = [ 1e-4, 0.02, 3e-3, -5e-5, 2e-5, 0]
delta_d = [ 5e-5, 12.5, -14.25, 1.75, -8e-5, 3e-4]
delta_alpha = [ -7e-4, 1.5e-3, 4e-3, -2e-4, 3e-4, 0]
calibration_status = 2 # 0 == notInitialised, 2 == linearised
joint_checksum = [ 0xd1a6d9c4, 0xd1a6d9c4, 0xd1a6d9c4, 0xd1a6d9c4, 0xd1a6d9c4, 0xd1a6d9c4]
"""
NOMINAL = """[DH]
a = [0.0, -0.612, -0.5723, 0.0, 0.0, 0.0]
d = [0.1273, 0.0, 0.0, 0.163941, 0.1157, 0.0922]
alpha = [ 1.570796327, 0.0, 0.0, 1.570796327, -1.570796327, 0.0 ]
"""
DELTAS = np.array(
    [
        [1e-7, -0.3, 0.25, 0.05, 1e-4, -2e-5],
        [1e-4, 0.02, 3e-3, -5e-5, 2e-5, 0],
        [5e-5, 12.5, -14.25, 1.75, -8e-5, 3e-4],
        [-7e-4, 1.5e-3, 4e-3, -2e-4, 3e-4, 0],
    ]
)


def flange(q: np.ndarray) -> np.ndarray:
    """The flange by the standard table itself: Rz(theta) Tz(d) Tx(a) Rx(alpha), joint by joint."""
    a = np.array([0, -0.612, -0.5723, 0, 0, 0]) + DELTAS[1]
    d = np.array([0.1273, 0, 0, 0.163941, 0.1157, 0.0922]) + DELTAS[2]
    alpha = np.array([1.570796327, 0, 0, 1.570796327, -1.570796327, 0]) + DELTAS[3]
    T = np.eye(4)
    for k in range(6):
        c, s, ca, sa = np.cos(q[k] + DELTAS[0, k]), np.sin(q[k] + DELTAS[0, k]), np.cos(alpha[k]), np.sin(alpha[k])
        row = [[c, -s * ca, s * sa, a[k] * c], [s, c * ca, -c * sa, a[k] * s], [0, sa, ca, d[k]], [0, 0, 0, 1]]
        T = T @ np.array(row)
    return T


def test_the_chain_is_that_of_the_table(tmp_path: Path) -> None:
    (tmp_path / "calibration.conf").write_text(MOUNTING)
    (tmp_path / "urcontrol.conf").write_text(NOMINAL)
    kernel = Kernel(read_any_robot(tmp_path / "calibration.conf"))
    q = np.random.default_rng(3).uniform(-3, 3, (10, 6))
    assert kernel.frames(kernel.theta0, kernel.poses(q)) == pytest.approx(
        np.array([flange(row) for row in q]), abs=1e-9
    )
    (tmp_path / "whole.conf").write_text(MOUNTING + NOMINAL)
    assert read_any_robot(tmp_path / "whole.conf").frames == kernel.model.frames


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (MOUNTING, "put urcontrol.conf of the same controller"),
        (NOMINAL, "no section"),
        ("garbage", "no configuration of a controller"),
        (MOUNTING.replace("0.02, ", "") + NOMINAL, "delta_a must be six numbers"),
        (MOUNTING.replace("12.5", "1e300") + NOMINAL, "beyond all measure"),
    ],
)
def test_what_is_missing_is_told(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "calibration.conf").write_text(text)
    with pytest.raises(InvalidInput, match=says):
        read_any_robot(tmp_path / "calibration.conf")

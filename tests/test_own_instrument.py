"""An instrument that the library does not know, written outside of it: heights of a dial gauge above a plane.

``docs/extending/instrument.md`` explains this file.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

import robcal
from examples.arrays_to_c import ROWS
from robcal.transforms import frame_from_xyzrpy, retract

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HeightObservations:
    """Heights of one point of the tool above the plane z = 0 of the world: a dial gauge on a surface plate.

    Attributes
    ----------
    pose : (m,) row of the pose. height : (m,) m. sigma : (m,) m. p_tool : (3,) m, the gauge's tip in tool coordinates.
    """

    pose: NDArray[np.int64]
    height: Array
    sigma: Array
    p_tool: Array
    dimension: ClassVar[int] = 1

    def evaluate(self, T: Array) -> tuple[Array, Array]:
        """Measured minus modelled height (m, 1), and what a small motion of the tool changes of it (m, 1, 6)."""
        R, t = T[self.pose, :3, :3], T[self.pose, :3, 3]
        modelled = (R @ self.p_tool + t)[:, 2]
        by_turn = np.cross(self.p_tool, R[:, 2])  # d/dw of e_z R (w x p) = (p x R' e_z) w
        return (self.height - modelled)[:, None], np.concatenate([R[:, 2], by_turn], axis=1)[:, None]

    def noise(self, T: Array) -> Array:
        """Variances (m, 1, 1)."""
        return (self.sigma**2)[:, None, None]

    def subset(self, poses: ArrayLike) -> "HeightObservations":
        """The rows of the given poses, renumbered to their order."""
        chosen = np.atleast_1d(np.asarray(poses))
        chosen = np.flatnonzero(chosen) if chosen.dtype == bool else chosen
        place = {int(p): i for i, p in enumerate(chosen)}
        rows = np.array([int(p) in place for p in self.pose], dtype=bool)
        pose = np.array([place[int(p)] for p in self.pose[rows]], dtype=np.int64)
        return replace(self, pose=pose, height=self.height[rows], sigma=self.sigma[rows])


TIP = np.array([0.01, -0.02, 0.15])


def simulated(n: int = 60) -> tuple[robcal.RobotModel, Array, Array]:
    """Nominal robot, joint angles (n, 6) and true tool frames (n, 4, 4) of one whose elbow is 2 mrad off its zero."""
    rng = np.random.default_rng(3)
    model = robcal.RobotModel("UR10", robcal.frames_from_dh(ROWS))
    q = rng.uniform(-2.0, 2.0, (n, 6))
    true = robcal.Kernel(replace(model, parameters={"axis3.yaw": 0.002}))
    return model, q, true.frames(true.theta0, true.poses(q))


def heights(T: Array, sigma: float) -> HeightObservations:
    z = (T[:, :3, :3] @ TIP + T[:, :3, 3])[:, 2]
    noise = np.random.default_rng(4).normal(0.0, sigma, len(T))
    return HeightObservations(np.arange(len(T)), z + noise, np.full(len(T), sigma), TIP)


def test_derivative() -> None:
    _, _, T = simulated(5)
    gauge = heights(T, 1e-5)
    r, B = gauge.evaluate(T)
    for k in range(6):
        step = np.zeros((5, 6))
        step[:, k] = 1e-6
        moved, _ = gauge.evaluate(retract(T, step))
        np.testing.assert_allclose((r - moved)[:, 0] / 1e-6, B[:, 0, k], atol=1e-6)


def test_heights_sharpen_an_identification() -> None:
    """Coarse frames leave the elbow uncertain; fine heights beside them make it more certain, and right."""
    model, q, T = simulated()
    rng = np.random.default_rng(5)
    coarse = retract(T, rng.normal(0.0, 1.0, (len(T), 6)) * ([5e-4] * 3 + [1e-3] * 3))
    frames = robcal.FrameObservations.isotropic(coarse, sigma=5e-4, sigma_angle=1e-3)
    options = robcal.IdentifyOptions(parameters="geometry", covariance="stated")
    poses = robcal.Kernel(model).poses(q)
    alone = robcal.identify(model, poses, [frames], options)
    both = robcal.identify(model, poses, [frames, heights(T, 5e-6)], options)
    sigma = dict(zip(both.names, both.sigma, strict=True))["axis3.yaw"]
    assert sigma < 0.5 * dict(zip(alone.names, alone.sigma, strict=True))["axis3.yaw"]
    assert both.values["axis3.yaw"] == pytest.approx(0.002, abs=4 * sigma)


def test_heights_alone_identify_a_robot_whose_cell_is_known() -> None:
    """Where the references of base and tool are given they are the start; heights alone then tell the elbow."""
    model, q, T = simulated()
    known = replace(model, world_T_base=np.eye(4), flange_T_tool=frame_from_xyzrpy(np.zeros(6)))
    options = robcal.IdentifyOptions(parameters=("axis3.yaw",), covariance="stated", robust=False)
    found = robcal.identify(known, robcal.Kernel(known).poses(q), [heights(T, 5e-6)], options)
    sigma = dict(zip(found.names, found.sigma, strict=True))["axis3.yaw"]
    assert found.values["axis3.yaw"] == pytest.approx(0.002, abs=4 * sigma)

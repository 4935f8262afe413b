"""The robot that a hand-eye calibration speaks of, ready to predict where its camera, or its board, is."""

from dataclasses import replace

import numpy as np

from robcal.calibration.calibrated import CalibratedRobot
from robcal.handeye.data import HandEyeData
from robcal.handeye.result import HandEye
from robcal.robot.model import GEOMETRIC_KINDS
from robcal.transforms import Array, adjoint, invert


def calibrated_robot(found: HandEye, data: HandEyeData) -> CalibratedRobot | None:
    """The robot with world and tool: the board and the camera in the hand, or the camera and the board in the hand.

    Its joints scatter as much as makes up for the robot's misses at the tool. None without a robot.
    """
    if data.robot is None:
        return None
    kernel = data.robot.kernel
    world, tool = (found.Z, found.X) if found.mounted == "hand" else (found.X, found.Z)
    values = dict(zip(found.robot_names, found.robot.tolist(), strict=True))
    now = {name: float(kernel.theta0[kernel.index[name]]) for name in values}
    model = kernel.model.with_parameters({name: now[name] + value for name, value in values.items()})
    model = replace(model, world_T_base=invert(world), flange_T_tool=tool)
    own = [f"{end}.{kind}" for end in ("base", "tool") for kind in GEOMETRIC_KINDS]
    robot = CalibratedRobot(
        model=model,
        names=(*own, *found.robot_names),
        covariance=_covariance(found, world),
        statics="one_step" if kernel.statics == "one_step" else "converged",
        nominal=replace(kernel.model, world_T_base=invert(world), flange_T_tool=tool),
    )
    return replace(robot, joint_sigma=_scatter(robot, found, data))


def _covariance(found: HandEye, world: Array) -> Array:
    """Of the right twists of ``world_T_base`` and tool, and of the robot's deviations."""
    p = len(found.robot)
    C = np.zeros((12 + p, 12 + p))
    C[:12, :12], C[12:, 12:] = found.covariance, found.robot_covariance
    C[:12, 12:], C[12:, :12] = found.with_robot, found.with_robot.T
    # a twist of base_T_world on its right is one of world_T_base on its left, carried to its right with the other sign
    J = np.eye(12 + p)
    first, second = (slice(6, 12), slice(0, 6)) if found.mounted == "hand" else (slice(0, 6), slice(6, 12))
    J[:12, :12] = 0.0
    J[0:6, first] = -adjoint(world)
    J[6:12, second] = np.eye(6)
    return np.asarray(J @ C @ J.T)


def _scatter(robot: CalibratedRobot, found: HandEye, data: HandEyeData) -> float:
    """Standard deviation (rad) of a joint that moves the tool as far as the robot misses, in place and turn."""
    if found.variances.place == 0.0 and found.variances.turn == 0.0:
        return 0.0
    assert data.robot is not None
    kernel = robot.kernel
    J = kernel.joint_jacobian(kernel.theta0, data.robot.inputs)
    place = np.sqrt(3.0) * found.variances.place / np.sqrt(np.mean(np.sum(J[:, :3] ** 2, axis=(1, 2))))
    turn = np.sqrt(3.0) * found.variances.turn / np.sqrt(np.mean(np.sum(J[:, 3:] ** 2, axis=(1, 2))))
    return float(max(place, turn))

"""Frames that a calibrated robot carries, in base coordinates: what is uncertain about them, and what they share."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from robcal.calibration.calibrated import CalibratedRobot
from robcal.robot.compensation import cell_frames
from robcal.robot.kernel import PoseInputs
from robcal.transforms import Array, adjoint, invert, transport_covariance

TOOL_NAMES = tuple(f"carried tool.{kind}" for kind in ("x", "y", "z", "roll", "pitch", "yaw"))


@dataclass(frozen=True)
class PlacedFrame:
    """A frame ``a_T_b`` and its uncertainty.

    Attributes
    ----------
    T : (4, 4).
    covariance : (6, 6) of its right twist, m and rad.
    names : parameters (k,) of the calibrated robot that it was found with.
    with_robot : (6, k) covariance of its error with the errors of these parameters.
    """

    T: Array
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)), repr=False)
    names: tuple[str, ...] = ()
    with_robot: Array = field(default_factory=lambda: np.zeros((6, 0)), repr=False)


FLANGE = PlacedFrame(np.eye(4))
"""The flange itself as a tool."""


@dataclass(frozen=True)
class CarriedFrames:
    """A frame on the robot at n poses.

    Attributes
    ----------
    T : (n, 4, 4) in base coordinates.
    names : errors (k,) that all poses have in common; covariance : (k, k) of them, SI.
    J : (n, 6, k) right twist of the frame by these errors.
    scatter : (n, 6, 6) covariance of the twist that is independent from pose to pose.
    """

    T: Array
    names: tuple[str, ...]
    covariance: Array = field(repr=False)
    J: Array = field(repr=False)
    scatter: Array = field(repr=False)

    def __len__(self) -> int:
        return len(self.T)

    def subset(self, rows: ArrayLike) -> "CarriedFrames":
        """The poses of the given rows."""
        at = np.asarray(rows, dtype=np.intp)
        return CarriedFrames(self.T[at], self.names, self.covariance, self.J[at], self.scatter[at])


def measured_frames(T: Array, covariance: Array | None = None) -> CarriedFrames:
    """Frames (n, 4, 4) that were measured and share no errors, as those of a probe held by hand."""
    n = len(T)
    scatter = np.zeros((n, 6, 6)) if covariance is None else covariance
    return CarriedFrames(T, (), np.zeros((0, 0)), np.zeros((n, 6, 0)), scatter)


def carried_frames(robot: CalibratedRobot, inputs: PoseInputs, tool: PlacedFrame | None = None) -> CarriedFrames:
    """Where the robot carries a tool.

    Parameters
    ----------
    tool : on the flange; None for the tool of the calibration. Its errors and those of the robot that it was found
        with are one: the covariance of both together is used where the tool states it for this robot's parameters.

    The base is the calibrated robot's own: errors of its place in the measuring system do not count here.
    """
    kernel = robot.kernel
    world_T_tool, J_all = kernel.frames_and_jacobian(kernel.theta0, inputs, robot.columns)
    world_T_base, calibrated_tool = cell_frames(kernel)
    moved = kernel.joint_jacobian(kernel.theta0, inputs) * np.asarray(robot.joint_sigma)
    leave = ("base.",) if tool is None else ("base.", "tool.")
    keep = [i for i, name in enumerate(robot.names) if not name.startswith(leave)]
    names = tuple(robot.names[i] for i in keep)
    covariance = robot.covariance[np.ix_(keep, keep)]
    T, J = invert(world_T_base) @ world_T_tool, J_all[:, :, keep]
    if tool is None:
        return CarriedFrames(T, names, covariance, J, moved @ np.swapaxes(moved, 1, 2))
    change = invert(tool.T) @ calibrated_tool
    T = T @ invert(change)
    move = adjoint(change)
    J = np.concatenate([move @ J, np.broadcast_to(np.eye(6), (len(T), 6, 6))], axis=2)
    shared = np.zeros((6, len(names)))
    if tool.names == names:
        shared = tool.with_robot
    joint = np.block([[covariance, shared.T], [shared, tool.covariance]])
    scatter = transport_covariance(move, moved @ np.swapaxes(moved, 1, 2))
    return CarriedFrames(T, (*names, *TOOL_NAMES), joint, J, scatter)

"""From an oriented station and an identified robot to the problem that adjusts both together."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import Rows
from robcal.calibration.problem import State, folded
from robcal.errors import InvalidInput
from robcal.joint_adjustment.problem import JointProblem, JointState, scatter_root
from robcal.photogrammetry.station.network import MarkTable, StationMarks, StationOrientation, Unknowns

START_SIGMA = 1e-4
"""Scatter of a joint (rad, m) to start from: so wide that marks alone place each pose at first."""


def assemble(
    orientation: StationOrientation,
    marks: Mapping[str, StationMarks],
    robot: CalibratedRobot,
    log: JointLog,
    tied: Rows,
) -> tuple[JointProblem, JointState, Rows]:
    """The problem, its start values, and the row in the joint log of each of its poses.

    Parameters
    ----------
    orientation : of the station by itself. marks : camera -> all identified marks.
    robot : identified from that station's frames; its fitted parameters are adjusted.
    tied : rows of the joint log whose poses hang on the robot; the others orient the cameras only.

    Raises
    ------
    InvalidInput : no mark of such a pose is left.
    """
    table, number = mark_table(orientation, marks, tied)
    rows, pose = np.unique(number, return_inverse=True)
    table = MarkTable(**{**vars(table), "pose": pose.astype(np.int64)})
    hang = np.isin(rows, tied)
    if not hang.any():
        raise InvalidInput("a joint adjustment needs marks of poses that the robot was identified from: none is left")
    kernel = robot.kernel
    start = folded(kernel, kernel.theta0, State(kernel.theta0, kernel.world_T_base, kernel.flange_T_tool))
    inputs = log.inputs(kernel).subset(rows)
    reference = np.tile(np.eye(4), (len(rows), 1, 1))
    at = np.searchsorted(orientation.poses, rows[~hang])
    reference[~hang] = orientation.world_T_body[at]
    sigma = np.full(kernel.model.n_joints, START_SIGMA)
    problem = JointProblem(
        marks=table,
        cameras=orientation.cameras,
        noise=np.array([orientation.noise[name] for name in orientation.names]),
        active=_active(orientation, table),
        prior=orientation.prior,
        kernel=kernel,
        inputs=inputs,
        columns=robot.columns,
        joint_sigma=sigma,
        root=scatter_root(kernel, start, inputs, sigma),
        tied=hang,
        reference=reference,
    )
    station = Unknowns(
        np.array([camera.vector for camera in orientation.cameras]),
        orientation.world_T_exterior,
        np.tile(np.eye(4), (len(rows), 1, 1)),
        np.nan_to_num(orientation.body.points),
    )
    return problem, JointState(station, start, np.zeros((len(rows), 6))), rows


def _active(orientation: StationOrientation, table: MarkTable) -> NDArray[np.bool_]:
    """(g,) what the station freed by itself, and the coordinates of all targets that have marks now."""
    active = orientation.design.active.copy()
    points = active[-3 * len(orientation.body) :].reshape(-1, 3)
    points[np.unique(table.target)] = True
    return active


def mark_table(
    orientation: StationOrientation, marks: Mapping[str, StationMarks], tied: Rows
) -> tuple[MarkTable, Rows]:
    """The marks that the station was oriented with and those of images that carry no pose by themselves.

    Also the pose number (m,) of each. What the station rejected stays out; poses that neither it nor the robot places
    have no use.
    """
    body = orientation.body
    placed = np.union1d(orientation.poses, tied)
    banned = {(r.camera, r.pose, r.target) for r in orientation.rejected if r.kind != "no_pose"}
    own = orientation.marks
    known = set(zip(own.camera.tolist(), orientation.poses[own.pose].tolist(), own.target.tolist(), strict=True))
    radius, normals = 0.5 * body.diameters, body.estimated_normals()
    tables, numbers = [own], [orientation.poses[own.pose]]
    for c, name in enumerate(orientation.names):
        m = marks[name]
        target = body.index(m.target)
        more = (target >= 0) & np.isin(m.pose, placed)
        more[more] &= body.known[target[more]]
        for i in np.flatnonzero(more):
            pose, number = int(m.pose[i]), int(m.target[i])
            out = (c, pose, int(target[i])) in known or (name, pose, number) in banned or (name, pose, -1) in banned
            more[i] = not out
        camera = np.full(int(more.sum()), c, dtype=np.int64)
        at = target[more]
        exterior = orientation.exterior_of(c, m.pose[more])
        tables.append(
            MarkTable(camera, exterior, m.pose[more], at, m.xy[more], m.covariance[more], radius[at], normals[at])
        )
        numbers.append(m.pose[more])
    table = MarkTable.concatenated(tables)
    return table, np.concatenate(numbers)

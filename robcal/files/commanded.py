"""Joint angles that rows of a measurement table state themselves: what was commanded when they were read.

Where a row states none, those of its pose hold. Readings at other angles than their pose's are a pose of their own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robcal.calibration.joint_log import RESTING, approach_from_order
from robcal.errors import InvalidInput
from robcal.files.measurement_tables import MeasuredTable
from robcal.files.poses_table import LIMIT_TOLERANCE, Poses, joint_columns
from robcal.files.tables import Table
from robcal.robot.model import RobotModel
from robcal.transforms import Array

Ints = NDArray[np.int64]


def commanded_angles(table: Table, robot: RobotModel | None) -> Array | None:
    """Joint angles (m, N) of a table's rows, rad or m; None where it states none.

    Raises
    ------
    InvalidInput : columns of some joints only, a cell that is no number, an angle beyond its joint's range.
    """
    if robot is None:
        return None
    joints = joint_columns(robot)
    if not any(table.has(name) for name, _ in joints):
        return None
    table.require([name for name, _ in joints])
    q = np.column_stack([table.numbers(name) * factor for name, factor in joints])
    for k, ((name, factor), joint) in enumerate(zip(joints, robot.joints, strict=True)):
        low, high = joint.limits or (-np.inf, np.inf)
        table.refuse(
            (q[:, k] < low - LIMIT_TOLERANCE) | (q[:, k] > high + LIMIT_TOLERANCE),
            lambda i, name=name, joint=joint, k=k, factor=factor: (  # type: ignore[misc]
                f"{name} = {q[i, k] / factor:g} lies outside the range of {joint.name}: correct the angle, or the "
                "range in the robot file"
            ),
        )
    return np.asarray(q)


@dataclass(frozen=True)
class _Own:
    """Readings of one pose at joint angles of their own: ``rows`` (table, row) of them, ``q`` (N,), ``time`` s."""

    pose: int
    q: Array
    rows: list[tuple[int, int]]
    time: float | None


def at_own_angles(poses: Poses, tables: Sequence[MeasuredTable]) -> tuple[Poses, list[MeasuredTable]]:
    """The joint log and the tables that refer to it, every reading at the joint angles that it states.

    A pose whose readings all state the same angles gets these; else a row of the log is added after it for each others.
    """
    own, at_pose = _groups(poses, tables)
    if not own:
        return poses, list(tables)
    source: list[int] = []
    q: list[Array] = []
    time: list[float | None] = []
    moved = np.zeros(len(poses), dtype=np.int64)
    new: dict[tuple[int, int], int] = {}
    for k in range(len(poses)):
        others = [g for g in own if g.pose == k]
        moved[k] = len(q)
        if k in at_pose or not others:
            source.append(k)
            q.append(poses.q[k])
            time.append(None)
        for g in others:
            new.update(dict.fromkeys(g.rows, len(q)))
            source.append(k)
            q.append(g.q)
            time.append(g.time)
    made = [replace(t, pose=moved[t.pose], q=None) for t in tables]
    places = [t.pose.copy() for t in made]
    for (table, row), at in new.items():
        places[table][row] = at
    return _log(poses, np.array(source), np.array(q), time), [
        replace(t, pose=place) for t, place in zip(made, places, strict=True)
    ]


def _groups(poses: Poses, tables: Sequence[MeasuredTable]) -> tuple[list[_Own], set[int]]:
    """Readings at angles of their own, in the order of the tables, and the poses that have readings at theirs."""
    found: dict[tuple[int, tuple[int, ...]], _Own] = {}
    at_pose: set[int] = set()
    for number, table in enumerate(tables):
        times = table.covariates.get("time_s")
        for row, pose in enumerate(table.pose.tolist()):
            q = None if table.q is None else table.q[row]
            if q is None or np.all(np.abs(q - poses.q[pose]) <= RESTING):
                at_pose.add(pose)
                continue
            key = (pose, tuple(np.round(q / RESTING).astype(np.int64).tolist()))
            group = found.setdefault(key, _Own(pose, q, [], None if times is None else float(times[row])))
            group.rows.append((number, row))
    return list(found.values()), at_pose


def _log(poses: Poses, source: Ints, q: Array, time: Sequence[float | None]) -> Poses:
    count: dict[int, int] = {}
    names = []
    for k in source.tolist():
        count[k] = count.get(k, 0) + 1
        names.append(poses.names[k] if count[k] == 1 else f"{poses.names[k]}#{count[k]}")
    if len(set(names)) < len(names):
        twice = next(n for n in names if names.count(n) > 1)
        raise InvalidInput(
            f"{poses.path}: a pose is named '{twice}', as readings of another one at angles of their own are: rename it"
        )
    approach = poses.approach[source]
    inferred = list(poses.inferred)
    approach[:, inferred] = approach_from_order(q)[:, inferred]
    covariates = {name: values[source].copy() for name, values in poses.covariates.items()}
    if "time_s" in covariates:
        stated = [k for k, t in enumerate(time) if t is not None]
        covariates["time_s"][stated] = [t for t in time if t is not None]
    return replace(
        poses,
        names=tuple(names),
        rows=poses.rows[source],
        q=q,
        payload=tuple(poses.payload[k] for k in source),
        verify=poses.verify[source],
        approach=approach,
        covariates=covariates,
    )

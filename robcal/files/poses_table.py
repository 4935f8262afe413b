"""poses.csv: one row per pose in the order in which they were driven."""

import re
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robcal.calibration.joint_log import JointLog, approach_from_order
from robcal.errors import InvalidInput
from robcal.files.schemas import proposal, shown
from robcal.files.tables import Table, read_table
from robcal.robot.hexapod import legs_of
from robcal.robot.loops import closing
from robcal.robot.model import RobotModel
from robcal.transforms import Array

LIMIT_TOLERANCE = 1e-3
"""Poses may lie this much (rad or m) beyond a limit: controllers round."""
LONGEST_STEP = 3600.0
"""Time (s) from one pose to the next that no recording takes as a rule."""
_HEADING = re.compile(r"(?:q|a|j|ax|axis|joint|e)[ _.]?\d{1,2}(?:[ _]?[\[(]?(?:deg|rad|mm|m|°)?[\])]?)")
"""Headings that controllers and other programs give to joints."""
_COLUMN = re.compile(r"q\d+_(deg|mm)|l\d+_mm")
NO_PAYLOAD = frozenset({"", "none", "-", "0"})


@dataclass(frozen=True, kw_only=True)
class Poses(JointLog):
    """The joint log of a campaign.

    Attributes
    ----------
    path : of the table; rows : (n,) row numbers in it.
    notes : what was assumed or ignored, in words.
    outside : the first pose beyond the robot's ranges, in words; empty if all are within.
    """

    path: Path
    rows: NDArray[np.int64] = field(repr=False)
    notes: tuple[str, ...] = ()
    outside: str = ""


def joint_columns(robot: RobotModel) -> list[tuple[str, float]]:
    """Column name and factor to SI of each joint, or of each leg of a Stewart platform."""
    if robot.is_hexapod:
        return [(f"l{k}_mm", 1e-3) for k in range(1, 7)]
    return [
        (f"q{k}_mm", 1e-3) if joint.prismatic else (f"q{k}_deg", np.pi / 180)
        for k, joint in enumerate(robot.joints, start=1)
    ]


def read_poses(path: Path, robot: RobotModel | None, payloads: Collection[str], *, to_predict: bool = False) -> Poses:
    """Read poses.csv; without a robot only the column ``pose`` counts.

    ``to_predict``: the contract's defaults for poses to predict: approach 0 (never inferred).

    Raises
    ------
    InvalidInput : the table contradicts the contract or the robot (columns, payloads). Poses beyond the limits are only
        told (``outside``), since exchanged columns or wrong signs lead there as well.
    """
    return poses_of(read_table(path), robot, payloads, to_predict=to_predict)


def poses_of(table: Table, robot: RobotModel | None, payloads: Collection[str], *, to_predict: bool = False) -> Poses:
    """The poses of a table, as :func:`read_poses` does it."""
    path = table.path
    table.require(["pose"])
    if not len(table):
        raise InvalidInput(f"{path}: lists no poses: one row per pose is needed")
    names = table.texts("pose")
    table.unique(["pose"])
    n = len(names)
    if robot is None:
        none = np.zeros((n, 0))
        return Poses(names, none, (None,) * n, np.zeros(n, bool), none, path=path, rows=table.rows)
    joints = joint_columns(robot)
    _check_joint_columns(table, [name for name, _ in joints])
    q = np.column_stack([table.numbers(name) * factor for name, factor in joints])
    _refuse_open_loops(table, robot, q)
    if robot.is_hexapod:
        found = legs_of(robot).forward(q)[1]
        table.refuse(~found, lambda i: f"no position of the platform has these leg lengths ({_lengths(q[i])} mm)")
    notes: list[str] = []
    approach, inferred = _approach(table, q, to_predict, notes)
    known = {"pose", "payload", "set", "target", "turn_deg", *(name for name, _ in joints)}
    known |= {f"approach{k}" for k in range(1, q.shape[1] + 1)}
    return Poses(
        path=path,
        names=names,
        rows=table.rows,
        q=q,
        payload=parse_payload(table, payloads),
        verify=_verify(table),
        approach=approach,
        inferred=inferred,
        covariates=_covariates(table, known, notes),
        notes=tuple(notes),
        outside=_outside(table, robot, q),
    )


def check_rows(table: Table, payloads: Collection[str] | None) -> None:
    """Look at the rows of poses.csv where the robot is not known; ``payloads`` None: nor which loads there are.

    Raises
    ------
    FaultyRows : a joint angle is no number, a load or a set is not known.
    """
    for name in table.columns:
        if _COLUMN.fullmatch(name):
            table.numbers(name)
    _verify(table)
    if payloads is not None:
        parse_payload(table, payloads)


def _joint_number(heading: str) -> int:
    return int(re.findall(r"\d+", heading)[0])


def _check_joint_columns(table: Table, wanted: list[str]) -> None:
    faults = []
    for k, name in enumerate(wanted, start=1):
        if name in table.columns:
            continue
        alike = [
            column for column in table.columns if _HEADING.fullmatch(column.lower()) and _joint_number(column) == k
        ]
        if alike:
            how = "the leg's length in mm" if name.startswith("l") else "the angle in degrees (a sliding joint in mm)"
            faults.append(
                f"{table.path}, row 1: joint column '{alike[0]}' must be '{name}': state {how} and name the "
                "column so, or map it in campaign.yaml with 'poses: {file: "
                f"{table.path.name}, columns: {{{name}: {alike[0]}}}}}'"
            )
        else:
            have = [column for column in table.columns if column not in wanted]
            faults.append(f"{table.path}, row 1: column '{name}' is missing{proposal(name, have)}: needed are {name}")
    if faults:
        raise InvalidInput(faults[0], faults)
    beyond = [c for c in table.columns if _COLUMN.fullmatch(c) and c not in wanted]
    if beyond:
        raise InvalidInput(
            f"{table.path}, row 1: column '{beyond[0]}' has no joint: the robot has {len(wanted)} joints "
            f"({', '.join(wanted)})"
        )


def _refuse_open_loops(table: Table, robot: RobotModel, q: Array) -> None:
    for f in robot.frames:
        if (bar := f.fourbar) is None:
            continue
        phi = q[:, bar.driver] + bar.crank_zero

        def sentence(i: int, name: str = f.name, column: int = bar.driver) -> str:
            return (
                f"the four-bar of frame '{name}' does not close at q{column + 1}_deg = {np.degrees(q[i, column]):g}: "
                "correct the angle, or lengths_mm and crank_zero_deg in the robot file"
            )

        table.refuse((np.abs(closing(bar.lengths, phi)) > 1.0).tolist(), sentence)


def _lengths(row: Array) -> str:
    return ", ".join(f"{1e3 * v:.3f}" for v in row)


def _outside(table: Table, robot: RobotModel, q: Array) -> str:
    for k, (joint, (column, factor)) in enumerate(zip(robot.joints, joint_columns(robot), strict=True)):
        if joint.limits is None:
            continue
        low, high = joint.limits
        outside = (q[:, k] < low - LIMIT_TOLERANCE) | (q[:, k] > high + LIMIT_TOLERANCE)
        if outside.any():
            i = int(np.argmax(outside))
            unit = "mm" if joint.prismatic else "deg"
            return str(
                table.error(
                    i,
                    f"{column} = {q[i, k] / factor:g} {unit} lies outside the range {low / factor:g} to "
                    f"{high / factor:g} "
                    f"{unit} of {joint.name} ({int(outside.sum())} such poses): correct the angle, or the range in the "
                    "robot file",
                )
            )
    return ""


def parse_payload(table: Table, payloads: Collection[str]) -> tuple[str | None, ...]:
    """The column ``payload``: name per row, None where it is empty or not there.

    Raises
    ------
    InvalidInput : a load that the campaign does not list.
    """
    if "payload" not in table.columns:
        return (None,) * len(table)
    cells = table.columns["payload"]
    known = sorted(payloads)

    def sentence(i: int) -> str:
        remedy = proposal(cells[i], known) or ": the campaign lists none"
        return f"payload '{cells[i][:60]}' is not known{remedy}; add it to 'payloads' in campaign.yaml"

    table.refuse([cell not in payloads and cell.lower() not in NO_PAYLOAD for cell in cells], sentence)
    return tuple(cell if cell in payloads else None for cell in cells)


def _verify(table: Table) -> NDArray[np.bool_]:
    if "set" not in table.columns:
        return np.zeros(len(table), dtype=bool)
    cells = table.columns["set"]
    bad = [cell not in ("identify", "verify") for cell in cells]
    table.refuse(bad, lambda i: f"set is {shown(cells[i])}, it must be 'identify' or 'verify'")
    return np.array([cell == "verify" for cell in cells])


def _approach(table: Table, q: Array, to_predict: bool, notes: list[str]) -> tuple[Array, tuple[int, ...]]:
    columns = [f"approach{k}" for k in range(1, q.shape[1] + 1)]
    given = [name in table.columns for name in columns]
    if to_predict or (table.has("l1_mm") and not any(given)):  # a leg's direction of approach is of no use so far
        approach = np.zeros_like(q)
        to_predict = True
    else:
        approach = approach_from_order(q)
        if not all(given):
            missing = ", ".join(name for name, there in zip(columns, given, strict=True) if not there)
            notes.append(f"approach directions inferred from the order of the poses ({table.path.name}: no {missing})")
    for k, name in enumerate(columns):
        if given[k]:
            values = table.numbers(name)
            cells = table.columns[name]
            told = f"{name} is {{}}, it must be -1, 0 or +1"
            table.refuse(~np.isin(values, (-1.0, 0.0, 1.0)), lambda i, cells=cells, told=told: told.format(cells[i]))  # type: ignore[misc]
            approach[:, k] = values
    return approach, () if to_predict else tuple(k for k, there in enumerate(given) if not there)


def _covariates(table: Table, known: set[str], notes: list[str]) -> dict[str, Array]:
    covariates: dict[str, Array] = {}
    for name in table.columns:
        if name in known:
            continue
        if name == "time_s" or re.fullmatch(r"temp_\w+_c", name):
            covariates[name] = table.numbers(name)
            if name == "time_s":
                notes.extend(_doubtful_times(table.path.name, covariates[name]))
            continue
        values = table.number_column(name)
        if values is None:
            notes.append(f"column '{name}' of {table.path.name} is not all numbers and is not used")
        else:
            covariates[name] = values
    return covariates


def _doubtful_times(file: str, time_s: Array) -> list[str]:
    """What speaks against the column ``time_s``: milliseconds, or a clock that runs back."""
    steps = np.diff(time_s)
    notes = []
    if len(steps) and float(np.median(steps)) > LONGEST_STEP:
        typical = float(np.median(steps))
        notes.append(
            f"column 'time_s' of {file}: {typical:.0f} s from one pose to the next: these look like milliseconds "
            f"({typical / 1000:.0f} s then): divide by 1000"
        )
    if (steps < 0).any():
        notes.append(f"column 'time_s' of {file} runs back at row {int(np.argmax(steps < 0)) + 3}: check the clock")
    return notes

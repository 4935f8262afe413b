"""Commands predict and compensate: tables in, tables out, on the robot of a finished run."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.robot_in_force import robot_in_force
from robcal.calibration.calibrated import CalibratedRobot
from robcal.errors import InvalidInput
from robcal.files.frame_tables import SIX, frame_columns, sigma_columns
from robcal.files.poses_table import joint_columns, parse_payload, read_poses
from robcal.files.storage import write_text
from robcal.files.tables import read_table, write_table
from robcal.robot.compensation import Compensation, cell_frames, compensate
from robcal.robot.export.controller_formats import frame_program, joint_program, program_name
from robcal.transforms import Array, frame_from_xyzrpy, invert


def predict_run(
    folder: Path,
    poses: Path,
    out: Path,
    *,
    nominal: bool = False,
    instrument: str | None = None,
    at_cycle: int | None = None,
) -> dict[str, Any]:
    """Write where the tool is at the given poses, in the coordinates of the measuring system (of an ``instrument``).

    Raises
    ------
    InvalidInput : no calibrated robot in the run, or a table that contradicts the contract.
    """
    calibrated = robot_in_force(folder, at_cycle, instrument)
    wanted = read_poses(poses, calibrated.model, calibrated.model.payloads, to_predict=True)
    robot = calibrated.uncalibrated() if nominal else calibrated
    T, covariance = robot.predict(robot.inputs(wanted))
    columns: dict[str, Sequence[object]] = {"pose": wanted.names, **frame_columns(T)}
    if not nominal:
        columns.update(sigma_columns(T, covariance))
    write_table(out, columns)
    warnings = [f"predicted all the same: {wanted.outside}"] if wanted.outside else []
    return {"poses": len(wanted), "out": str(out), "nominal": nominal, "warnings": warnings}


@dataclass(frozen=True)
class WantedFrames:
    """Frames that the tool is to reach."""

    names: tuple[str, ...]
    T: Array
    payload: tuple[str | None, ...]
    covariates: dict[str, Array]


def read_wanted(path: Path, payloads: Collection[str]) -> WantedFrames:
    """Read a table of wanted tool frames: pose, six numbers, optional payload and covariates.

    Raises
    ------
    InvalidInput : missing columns, NaN, doubled poses, an unknown payload.
    """
    table = read_table(path)
    table.require(["pose", "x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg"])
    if not len(table):
        raise InvalidInput(f"{path}: lists no frames")
    names = table.texts("pose")
    table.unique(["pose"])
    offsets = [table.numbers(f"{n}_mm") / 1000 for n in SIX[:3]]
    six = np.column_stack([*offsets, *(np.radians(table.numbers(f"{n}_deg")) for n in SIX[3:])])
    other = {"pose", "payload", *(f"{n}_mm" for n in SIX[:3]), *(f"{n}_deg" for n in SIX[3:])}
    covariates = {n: v for n in table.columns if n not in other and (v := table.number_column(n)) is not None}
    return WantedFrames(names, frame_from_xyzrpy(six), parse_payload(table, payloads), covariates)


@dataclass(frozen=True)
class CompensateOptions:
    """What is to be written, and for which frames.

    Attributes
    ----------
    as_frames : targets F* in place of joint angles. in_base : the wanted frames are given in the robot's base.
    skip_unreachable : leave frames out that the robot cannot reach. program : controller to write a program for.
    instrument, at_cycle : which robot; see :func:`pipeline.robot_in_force.robot_in_force`.
    """

    as_frames: bool = False
    in_base: bool = False
    skip_unreachable: bool = False
    program: str | None = None
    instrument: str | None = None
    at_cycle: int | None = None


def compensate_run(
    folder: Path, frames: Path, out: Path, options: CompensateOptions = CompensateOptions()
) -> dict[str, Any]:
    """Write the commands that bring the real tool to the wanted frames: a table, or a ``program`` of a controller.

    Raises
    ------
    InvalidInput : no calibrated robot in the run, a bad table, or a frame that the robot cannot reach.
    """
    calibrated = robot_in_force(folder, options.at_cycle, options.instrument)
    wanted = read_wanted(frames, calibrated.model.payloads)
    covariates = {name: np.full(len(wanted.T), value) for name, value in calibrated.defaults.items()}
    in_world = cell_frames(calibrated.kernel)[0] @ wanted.T if options.in_base else wanted.T
    result = compensate(
        calibrated.kernel,
        wanted.T,
        payload=wanted.payload,
        covariates={**covariates, **wanted.covariates},
        near=calibrated.nearest_recorded(in_world),
        frame="base" if options.in_base else "world",
    )
    unreachable = np.flatnonzero(~result.reachable)
    if len(unreachable) and (not options.skip_unreachable or len(unreachable) == len(wanted.T)):
        raise _unreachable(frames, wanted, result)
    rows = np.flatnonzero(result.reachable)
    warnings = [f"{frames}: frame '{wanted.names[i]}' left out: {result.reason[i]}" for i in unreachable]
    missed = [wanted.names[i] for i in rows if not result.converged[i]]
    warnings += [f"{frames}: frame '{name}' is met only approximately (near a singular pose?)" for name in missed]
    if options.program is None:
        write_table(out, _command_columns(calibrated, wanted, result, options.as_frames))
    elif options.as_frames:
        write_text(out, _frame_program(calibrated, result, options.program, program_name(out.stem), options.in_base))
        warnings += _program_warnings(frames, out, options)
    else:
        write_text(out, joint_program(calibrated.model, result.q[rows], options.program, program_name(out.stem)))
    remaining = np.linalg.norm(result.remaining[rows, :3], axis=1) * 1000
    before = np.linalg.norm(result.before[rows, :3], axis=1) * 1000
    return {
        "frames": len(rows),
        "left_out": [wanted.names[i] for i in unreachable],
        "out": str(out),
        "remaining_max_mm": float(remaining.max()),
        "uncompensated_mean_mm": float(np.nanmean(before)),
        "warnings": warnings,
    }


def _unreachable(frames: Path, wanted: WantedFrames, result: Compensation) -> InvalidInput:
    bad = np.flatnonzero(~result.reachable)
    count = f" ({len(bad)} of {len(wanted.T)} frames)" if len(bad) > 1 else ""
    return InvalidInput(
        f"{frames}: the robot cannot reach frame '{wanted.names[bad[0]]}'{count}: {result.reason[bad[0]]}: move the "
        "frame, check --in (coordinates) and the payload, or leave such frames out with --skip-unreachable"
    )


def _command_columns(
    calibrated: CalibratedRobot, wanted: WantedFrames, result: Compensation, as_frames: bool
) -> dict[str, Sequence[object]]:
    """The reachable frames as a table of targets or of joint angles."""
    rows = np.flatnonzero(result.reachable)
    columns: dict[str, Sequence[object]] = {"pose": [wanted.names[i] for i in rows]}
    if as_frames:
        return columns | frame_columns(result.F_star[rows])
    for k, (name, factor) in enumerate(joint_columns(calibrated.model)):
        columns[name] = [f"{v:.9f}" for v in result.q[rows, k] / factor]
    return columns


def _frame_program(calibrated: CalibratedRobot, result: Compensation, program: str, name: str, in_base: bool) -> str:
    """A program of targets; it makes the robot's base the active one, whatever the wanted frames were given in."""
    rows = np.flatnonzero(result.reachable)
    world_T_base, tool = cell_frames(calibrated.kernel)
    targets = result.F_star[rows] if in_base else invert(world_T_base) @ result.F_star[rows]
    return frame_program(targets, program, name, tool, model=calibrated.model, q=result.q[rows])


def _program_warnings(frames: Path, out: Path, options: CompensateOptions) -> list[str]:
    load = "the tool data 'tool_robcal' hold 1 kg" if options.program == "rapid" else "the tool is set without its load"
    warnings = [f"{out}: {load}: give the controller the real load data"]
    if not options.in_base:
        warnings.append(
            f"{frames}: read in the measuring system's coordinates, not in the robot's base (--in base); the "
            "program's targets are converted to base coordinates"
        )
    return warnings

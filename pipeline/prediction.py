"""Commands predict and compensate: tables in, tables out, on the robot of a finished run."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.robot_in_force import robot_in_force
from robcal.errors import InvalidInput
from robcal.files.frame_tables import SIX, frame_columns, sigma_columns
from robcal.files.poses_table import joint_columns, parse_payload, read_poses
from robcal.files.storage import write_text
from robcal.files.tables import read_table, write_table
from robcal.robot.compensation import cell_frames, compensate
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
    robot = calibrated.bare() if nominal else calibrated
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


def compensate_run(
    folder: Path,
    frames: Path,
    out: Path,
    *,
    as_frames: bool = False,
    in_base: bool = False,
    skip_unreachable: bool = False,
    program: str | None = None,
    instrument: str | None = None,
    at_cycle: int | None = None,
) -> dict[str, Any]:
    """Write the commands that bring the real tool to the wanted frames: a table, or a ``program`` of a controller.

    Raises
    ------
    InvalidInput : no calibrated robot in the run, a bad table, or a frame that the robot cannot reach.
    """
    calibrated = robot_in_force(folder, at_cycle, instrument)
    model = calibrated.model
    wanted = read_wanted(frames, model.payloads)
    covariates = {name: np.full(len(wanted.T), value) for name, value in calibrated.defaults.items()}
    covariates.update(wanted.covariates)
    result = compensate(
        calibrated.kernel,
        wanted.T,
        payload=wanted.payload,
        covariates=covariates,
        near=calibrated.nearest_recorded(cell_frames(calibrated.kernel)[0] @ wanted.T if in_base else wanted.T),
        frame="base" if in_base else "world",
    )
    unreachable = np.flatnonzero(~result.reachable)
    if len(unreachable) and (not skip_unreachable or len(unreachable) == len(wanted.T)):
        i = int(unreachable[0])
        count = f" ({len(unreachable)} of {len(wanted.T)} frames)" if len(unreachable) > 1 else ""
        raise InvalidInput(
            f"{frames}: the robot cannot reach frame '{wanted.names[i]}'{count}: {result.reason[i]}: move the frame, "
            "check --in (coordinates) and the payload, or leave such frames out with --skip-unreachable"
        )
    rows = np.flatnonzero(result.reachable)
    warnings = [f"{frames}: frame '{wanted.names[i]}' left out: {result.reason[i]}" for i in unreachable]
    missed = [wanted.names[i] for i in rows if not result.converged[i]]
    warnings += [f"{frames}: frame '{name}' is met only approximately (near a singular pose?)" for name in missed]
    if program is not None:
        name, q = program_name(out.stem), result.q[rows]
        if as_frames:
            # the program makes the robot's base the active one, whatever the wanted frames were given in
            world_T_base, tool = cell_frames(calibrated.kernel)
            targets = result.F_star[rows] if in_base else invert(world_T_base) @ result.F_star[rows]
            text = frame_program(targets, program, name, tool, model=model, q=q)
            load = "the tool data 'tool_robcal' hold 1 kg" if program == "rapid" else "the tool is set without its load"
            warnings.append(f"{out}: {load}: give the controller the real load data")
            if not in_base:
                warnings.append(
                    f"{frames}: read in the measuring system's coordinates, not in the robot's base (--in base); the "
                    "program's targets are converted to base coordinates"
                )
        else:
            text = joint_program(model, q, program, name)
        write_text(out, text)
    else:
        columns: dict[str, Sequence[object]] = {"pose": [wanted.names[i] for i in rows]}
        if as_frames:
            columns.update(frame_columns(result.F_star[rows]))
        else:
            for k, (name, factor) in enumerate(joint_columns(model)):
                columns[name] = [f"{v:.9f}" for v in result.q[rows, k] / factor]
        write_table(out, columns)
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

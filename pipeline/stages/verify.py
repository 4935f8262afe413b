"""Stage verify: the calibrated robot on poses that took no part, and the files that hand it on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.calibrated import Calibrated, load_calibrated, recorded_inputs
from pipeline.codec import save_arrays
from pipeline.poses_table import Poses
from pipeline.robot_file import write_robot
from pipeline.runs import Run
from pipeline.stages.base import Context, Outcome, Stage, no_files
from pipeline.stages.identify import load_identification, options_of, require_robot
from pipeline.stages.observations import RobotObservations, RobotRecording, Rows
from pipeline.tables import write_table
from robcal.calibration.identification import IdentifiedRobot, predict_frames
from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    PointObservations,
    SensorPointObservations,
)
from robcal.calibration.verification import (
    ErrorStatistics,
    Verification,
    cross_validate,
    fit_nominal,
    repetitions,
    verify,
)
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import parameter_unit

NAME = "verify"
FOLDS = 5
WEAK = 10.0
"""A kept-out frame whose measurement is this many times less certain than usual says nothing about the robot."""


def work(context: Context) -> Outcome:
    """Verify on the kept-out poses, or by folds where there are none; write the calibrated robot."""
    campaign, run = context.campaign, context.run
    robot, poses = require_robot(campaign)
    identification = load_identification(run)
    rows = identification.rows
    # what the diagnosis found in the measuring system is no error of the robot
    taken_back = run.record("diagnose") is not None and run.has("corrected")
    recording: RobotRecording = run.load("corrected") if taken_back else identification.recording
    calibrated = load_calibrated(run)
    beside = calibrated
    if taken_back and run.has("relative"):
        beside = replace(calibrated, covariance=run.load("relative"))
    final = with_model(identification.robot(), beside)
    inputs = recorded_inputs(final.kernel, poses)
    kept_out = np.array([i for i in recording.poses if poses.verify[i]], dtype=np.int64)
    notes = ["verified without the errors of the measuring system that all poses share"] * taken_back
    kept_out, said = well_measured(recording, kept_out, poses.names)
    notes += said
    if len(kept_out):
        nominal = fit_nominal(robot, inputs.subset(rows), recording.select(rows))
        outcome = verify(final, inputs.subset(kept_out), recording.select(kept_out), nominal)
        if beside is not calibrated:
            # in the world, the robot is as uncertain as the station as well
            _, C = predict_frames(with_model(identification.robot(), calibrated), inputs.subset(kept_out))
            outcome = replace(outcome, predicted=np.sqrt(np.trace(C[:, :3, :3], axis1=1, axis2=2) / 3.0))
        tested = kept_out
    else:
        groups = repetitions(poses.q[rows])
        folds = min(FOLDS, int(groups.max()) + 1)
        options = options_of(campaign, recording.stated)
        with_terms = robot.with_terms(calibrated.model.terms)
        outcome = cross_validate(
            with_terms, inputs.subset(rows), recording.select(rows), options, folds=folds, groups=groups
        )
        tested = rows
        notes.append(f"no verification poses: {folds}-fold cross-validation over groups of poses")
    write_robot(run.robot, calibrated.model, f"calibrated from campaign {campaign.name}")
    _write_covariance(run, calibrated)
    _write_residuals(run, poses, inputs, final, recording.observations)
    outputs = [run.save(NAME, (outcome, tested)), run.robot, run.covariance, run.residuals]
    return Outcome({"verification": _result(outcome)}, outputs, notes)


def well_measured(recording: RobotRecording, kept_out: Rows, names: Sequence[str]) -> tuple[Rows, list[str]]:
    """Kept-out poses without those of which one camera alone saw the plate, where most were measured much better."""
    frames = [o for o in recording.observations if isinstance(o, FrameObservations)]
    if len(frames) != 1 or len(recording.observations) != 1:
        return kept_out, []
    sigma = np.sqrt(np.trace(frames[0].covariance[:, :3, :3], axis1=1, axis2=2) / 3.0)
    limit = WEAK * float(np.median(sigma))
    weak = np.isin(kept_out, frames[0].pose[sigma > limit])
    if not weak.any() or np.count_nonzero(weak) > len(kept_out) / 2:
        return kept_out, []
    listed = ", ".join(names[i] for i in kept_out[weak])
    worst = 1e3 * float(sigma[np.isin(frames[0].pose, kept_out[weak])].max())
    note = (
        f"verified without {listed}: measured to {worst:.2g} mm only (usual: {1e3 * limit / WEAK:.2g} mm), which would "
        "tell of the measurement, not of the robot"
    )
    return kept_out[~weak], [note]


def with_model(found: IdentifiedRobot, calibrated: Calibrated) -> IdentifiedRobot:
    """The identified robot with the model that the diagnosis left behind."""
    if not calibrated.diagnosed:
        return found
    kernel = Kernel(calibrated.model, calibrated.statics)
    theta = np.array([kernel.theta0[kernel.index[name]] for name in calibrated.names])
    model, covariance = calibrated.model, calibrated.covariance
    return replace(found, model=model, kernel=kernel, names=calibrated.names, theta=theta, covariance=covariance)


def _write_covariance(run: Run, calibrated: Calibrated) -> None:
    kernel = Kernel(calibrated.model, calibrated.statics)
    save_arrays(
        run.covariance,
        {
            "names": np.array(calibrated.names, dtype=np.str_),
            "units": np.array([parameter_unit(calibrated.model, name) for name in calibrated.names], dtype=np.str_),
            "theta": np.array([kernel.theta0[kernel.index[name]] for name in calibrated.names]),
            "covariance": calibrated.covariance,
        },
    )


_KINDS: Mapping[type, str] = {
    FrameObservations: "frame",
    PointObservations: "point",
    DistanceObservations: "distance",
    SensorPointObservations: "sensor_point",
}


def _write_residuals(
    run: Run, poses: Poses, inputs: PoseInputs, robot: IdentifiedRobot, observations: Sequence[RobotObservations]
) -> None:
    """residuals.csv: measured minus modelled; frames as a turn vector and in tool coordinates, points in the world."""
    T = robot.kernel.frames(robot.full_theta, inputs)
    names = ("dx_mm", "dy_mm", "dz_mm", "rx_deg", "ry_deg", "rz_deg")
    columns: dict[str, list[object]] = {n: [] for n in ("pose", "set", "kind", "target", *names, "normalised")}
    for o in observations:
        r, _ = o.evaluate(T)
        white = np.linalg.solve(np.linalg.cholesky(o.noise(T)), r[..., None])[..., 0]
        scaled = r * np.array([1000.0] * 3 + [180 / np.pi] * 3)[: r.shape[1]]
        for i, pose in enumerate(o.pose):
            columns["pose"].append(poses.names[pose])
            columns["set"].append("verify" if poses.verify[pose] else "identify")
            columns["kind"].append(_KINDS[type(o)])
            columns["target"].append(int(o.target[i]) if isinstance(o, PointObservations) else "")
            for k, name in enumerate(names):
                columns[name].append(f"{scaled[i, k]:.6f}" if k < scaled.shape[1] else "")
            columns["normalised"].append(f"{np.sqrt(np.mean(white[i] ** 2)):.4f}")
    write_table(run.residuals, columns)


def _statistics(tools: Mapping[str, ErrorStatistics]) -> dict[str, dict[str, float]]:
    return {name: {key: value * 1000 for key, value in vars(errors).items()} for name, errors in tools.items()}


def _result(outcome: Verification) -> dict[str, Any]:
    result: dict[str, Any] = {
        "kind": outcome.kind,
        "poses": outcome.poses,
        "tools": _statistics(outcome.tools),
        "nominal": None if outcome.nominal is None else _statistics(outcome.nominal),
        "p_value": outcome.p_value,
        "coverage_95": outcome.coverage_95,
        "predicted_sigma_mm": float(np.sqrt(np.mean(outcome.predicted**2)) * 1000),
        "normalised_error_squared": float(np.sum(outcome.normalised * outcome.degrees) / max(outcome.degrees.sum(), 1)),
    }
    if outcome.iso is not None:
        result["iso9283"] = {
            "AP_mean_mm": outcome.iso.ap_mean * 1000,
            "AP_max_mm": outcome.iso.ap_max * 1000,
            "AP_orientation_mean_deg": float(np.degrees(outcome.iso.ap_orientation_mean)),
            "AP_orientation_max_deg": float(np.degrees(outcome.iso.ap_orientation_max)),
            "RP_mean_mm": outcome.iso.rp_mean * 1000,
            "RP_max_mm": outcome.iso.rp_max * 1000,
            "groups": outcome.iso.groups,
        }
    return result


def load_verification(run: Run) -> tuple[Verification, Rows]:
    """Result of the stage and the rows of the poses it was made on."""
    found: tuple[Verification, Rows] = run.load(NAME)
    return found


STAGE = Stage(
    name=NAME,
    applies=lambda campaign: campaign.robot is not None and campaign.poses is not None,
    work=work,
    inputs=no_files,
    settings=lambda campaign: [campaign.name, campaign.entry.model_dump(include={"model"})],
    after=("identify", "diagnose"),
    module=__name__,
)

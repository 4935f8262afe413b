"""Stage verify: the calibrated robot on poses that took no part, and the files that hand it on."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline import artifacts
from pipeline.codec import save_arrays
from pipeline.instrument_results import instruments_result
from pipeline.json_io import read_json
from pipeline.runs import Run
from pipeline.stages.base import Context, Outcome, Stage, no_files
from pipeline.stages.identify import load_calibrated, options_of, require_robot
from pipeline.stages.survey import located
from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.instruments import IdentifiedInstruments
from robcal.calibration.measurements import RobotObservations
from robcal.calibration.noise_parts import NoiseParts
from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    PointObservations,
    SensorPointObservations,
)
from robcal.calibration.verdict import verdict
from robcal.calibration.verification import ErrorStatistics, Verification
from robcal.errors import InvalidInput
from robcal.files.poses_table import Poses
from robcal.files.robot_file import write_robot
from robcal.files.tables import write_table
from robcal.recipe.agreement import disagreements
from robcal.recipe.instruments import telling_verification, verify_instruments
from robcal.recipe.noise import noise_of
from robcal.recipe.verdict import robot_facts
from robcal.recipe.verification import RobotVerification, datum_note, verify_robot
from robcal.robot.model import parameter_unit

NAME = "verify"
PAYS = 0.95
"""Share of the error that has to be left for approach directions to be worth stating."""


def work(context: Context) -> Outcome:
    """Verify on the kept-out poses, or by folds where there are none; write the calibrated robot."""
    campaign, run = context.campaign, context.run
    robot, poses = require_robot(campaign)
    identification = run.load(artifacts.IDENTIFICATION)
    calibrated = load_calibrated(run)
    diagnosed = run.record("diagnose") is not None
    placed = run.find(artifacts.PLACED) if diagnosed else None
    delivered = run.find(artifacts.DELIVERED) if diagnosed else None
    options = options_of(campaign, identification.recording.stated)
    instruments = run.find(artifacts.INSTRUMENTS)
    verified: dict[str, Verification] = {}
    try:
        if instruments is not None:
            verified = verify_instruments(robot, instruments, poses, options)
            found = telling_verification(instruments, verified)
        else:
            # a diagnosis has verified already what it delivers
            found = delivered or verify_robot(robot, identification, calibrated, poses, options)
    except InvalidInput as error:
        raise located(error, str(poses.path)) from None
    write_robot(run.robot, calibrated.model, f"calibrated from campaign {campaign.name}")
    _write_covariance(run, calibrated)
    _write_residuals(run, poses, calibrated, identification.recording.observations, instruments)
    outputs = [
        run.save(artifacts.VERIFICATION, (found.delivered, found.rows)),
        run.robot,
        run.covariance,
        run.residuals,
    ]
    datum = "" if instruments is not None else datum_note(identification, calibrated, poses, placed)
    notes = [*found.notes, *_approach_note(found), *filter(None, [datum])]
    if placed is not None:
        notes.append(
            "station or base moved during the recording: the robot speaks in the frame of the first pose; errors are "
            "against the measurements as they are, those as recorded with the moves taken back"
        )
    diagnosis = read_json(run.diagnosis) if diagnosed and run.diagnosis.is_file() else None
    recording = identification.recording
    wrong = [] if instruments is not None else disagreements(found, calibrated, poses, recording, diagnosis)
    doubts = doubtful_coordinates(run)
    judged = verdict(robot_facts(identification, calibrated, poses, found.delivered, diagnosis, doubts, wrong))
    told = {"grade": judged.grade, "text": judged.text, "reasons": list(judged.reasons)}
    noise = noise_of(identification, calibrated, poses)
    result = {"verification": verification_result(found), "noise": _noise_result(noise), "verdict": told}
    if instruments is not None:
        sections = {name: verification_result(RobotVerification(v, None, v.rows)) for name, v in verified.items()}
        result["instruments"] = instruments_result(instruments, sections)
    return Outcome(result, outputs, [*notes, *noise.notes])


def _approach_note(found: RobotVerification) -> list[str]:
    """What stating approach directions would gain."""
    if found.unstated is None or found.recorded is None:
        return []
    before, after = (1e3 * v.tools["0"].rms for v in (found.unstated, found.recorded))
    if after > PAYS * before:
        return []
    return [f"state approach: {before:.3f} -> {after:.3f} mm RMS at the kept-out poses"]


def _noise_result(noise: NoiseParts) -> dict[str, Any]:
    return {
        "measurement_mm": 1e3 * noise.measurement,
        "source": noise.source,
        "stated_mm": None if noise.stated is None else 1e3 * noise.stated,
        "joint_scatter_deg": None if noise.joint_scatter is None else float(np.degrees(noise.joint_scatter)),
        "lack_of_fit_mm": 1e3 * noise.lack_of_fit,
        "repeats": noise.repeats,
        "p_value": noise.p_value,
    }


def doubtful_coordinates(run: Run) -> list[str]:
    """What the surveys say against the coordinates that were given."""
    record = run.record("survey")
    surveys = dict(record.result).get("survey", {}) if record is not None else {}
    return [doubt for entry in surveys.values() for doubt in entry.get("contradictions", [])]


def _write_covariance(run: Run, calibrated: CalibratedRobot) -> None:
    save_arrays(
        run.covariance,
        {
            "names": np.array(calibrated.names, dtype=np.str_),
            "units": np.array([parameter_unit(calibrated.model, name) for name in calibrated.names], dtype=np.str_),
            "theta": calibrated.theta,
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
    run: Run,
    poses: Poses,
    robot: CalibratedRobot,
    observations: Sequence[RobotObservations],
    instruments: IdentifiedInstruments | None = None,
) -> None:
    """residuals.csv: measured minus modelled; frames as a turn vector and in tool coordinates, points in the world."""
    if instruments is None:
        write_table(run.residuals, _residual_columns(poses, robot, observations))
        return
    columns: dict[str, list[object]] = {}
    for name, placed in instruments.placed.items():
        some = _residual_columns(poses, instruments.seen_by(name, robot), placed.recording.observations)
        some["instrument"] = [name] * len(some["pose"])
        for key, values in some.items():
            columns.setdefault(key, []).extend(values)
    write_table(run.residuals, columns)


def _residual_columns(
    poses: Poses, robot: CalibratedRobot, observations: Sequence[RobotObservations]
) -> dict[str, list[object]]:
    T = robot.predict(poses.inputs(robot.kernel))[0]
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
    return columns


def _statistics(tools: Mapping[str, ErrorStatistics]) -> dict[str, dict[str, float]]:
    return {name: {key: value * 1000 for key, value in vars(errors).items()} for name, errors in tools.items()}


def verification_result(found: RobotVerification) -> dict[str, Any]:
    """Section `verification` of result.json, mm and deg."""
    outcome = found.delivered
    delivered = _statistics(outcome.tools)["0"]
    result: dict[str, Any] = {
        "kind": outcome.kind,
        "poses": outcome.poses,
        "delivered": {name: delivered[name] for name in ("mean", "max", "rms")},
        "as_recorded": None if found.recorded is None else _statistics(found.recorded.tools),
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


STAGE = Stage(
    name=NAME,
    applies=lambda campaign: campaign.robot is not None and campaign.poses is not None,
    work=work,
    inputs=no_files,
    settings=lambda campaign: [campaign.name, campaign.entry.model_dump(include={"model"})],
    after=("identify", "diagnose"),
    module=__name__,
)

"""Stage identify: geometry and elasticity of the robot from everything that was measured of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from pipeline.bodies import body_for_robot
from pipeline.calibrated import Calibrated, defaults_of, recorded_inputs
from pipeline.campaign import Campaign
from pipeline.poses_table import Poses
from pipeline.robot_file import write_robot
from pipeline.runs import Run
from pipeline.stages.base import Context, Outcome, Stage
from pipeline.stages.joint_log import check_failed_fit, check_joint_log
from pipeline.stages.observations import RobotObservations, RobotRecording, Rows, build_recording, rescaled
from robcal.calibration.identification import IdentifiedRobot, IdentifyOptions, identify
from robcal.calibration.observations import FrameObservations
from robcal.calibration.verification import fit_nominal
from robcal.errors import InvalidInput
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import RobotModel
from robcal.transforms import Array

NAME = "identify"


SUFFIXES = {".csv", ".yaml", ".yml", ".urdf", ".xml"}
"""Files of a campaign that this stage may depend on; all others are images."""


@dataclass(frozen=True)
class Identification:
    """What the stages after it need.

    Attributes
    ----------
    rows : (n,) rows in the table of poses of the poses that were identified from.
    facts : the fields of :class:`IdentifiedRobot` except its kernel, which is built again from the model.
    recording : the measurements, with the uncertainty estimated where none was stated.
    """

    rows: Rows
    facts: Mapping[str, Any] = field(repr=False)
    recording: RobotRecording = field(repr=False)

    def robot(self) -> IdentifiedRobot:
        """The identified robot with its kernel."""
        model, options = self.facts["model"], self.facts["options"]
        return IdentifiedRobot(kernel=Kernel(model, options.statics), **self.facts)


def options_of(campaign: Campaign, stated: bool) -> IdentifyOptions:
    """Choices of the identification from campaign.yaml."""
    chosen = campaign.entry.model
    return IdentifyOptions(
        parameters=chosen.parameters if isinstance(chosen.parameters, str) else tuple(chosen.parameters),
        robust=chosen.robust,
        objective="basis" if chosen.objective == "basis_norm" else "maximum_likelihood",
        statics=chosen.statics,
        joint_sigma=None if chosen.joint_sigma_deg is None else float(np.radians(chosen.joint_sigma_deg)),
        covariance="auto" if stated else "estimated",
    )


def work(context: Context) -> Outcome:
    """Identify the robot from the poses that are not kept out."""
    campaign, run = context.campaign, context.run
    robot, poses = require_robot(campaign)
    recording = build_recording(campaign, run, body_for_robot(campaign, run))
    rows = np.array([i for i in recording.poses if not poses.verify[i]], dtype=np.int64)
    if not len(rows):
        raise InvalidInput(f"{poses.path}: no measured pose is left to identify from: set 'identify' in the column set")
    kernel = Kernel(robot, campaign.entry.model.statics)
    inputs = recorded_inputs(kernel, poses)
    options = options_of(campaign, recording.stated)
    check_joint_log(robot, poses, inputs, recording, kernel)
    nominal = fit_nominal(robot, inputs.subset(rows), recording.select(rows))
    found, recording = identify_recording(robot, inputs, recording, rows, options, kernel)
    if recording.stated:
        check_failed_fit(robot, poses, inputs, recording, kernel, found)
    calibrated = calibrated_robot(poses, inputs, found, nominal.model)
    facts = {f.name: getattr(found, f.name) for f in fields(found) if f.name != "kernel"}
    outputs = [run.save(NAME, Identification(rows, facts, recording)), run.save(f"calibrated_{NAME}", calibrated)]
    write_robot(run.robot, found.model, f"calibrated from campaign {campaign.name}, before the diagnosis")
    notes = [*recording.notes, *_notes(found, poses, rows)]
    return Outcome({"identification": _result(found, rows)}, outputs, notes)


def require_robot(campaign: Campaign) -> tuple[RobotModel, Poses]:
    """The robot and its poses.

    Raises
    ------
    InvalidInput : the campaign has none.
    """
    if campaign.robot is None or campaign.poses is None:
        raise InvalidInput(f"{campaign.path}: no robot or no poses: add 'robot' and 'poses'")
    return campaign.robot, campaign.poses


def identify_recording(
    robot: RobotModel,
    inputs: PoseInputs,
    recording: RobotRecording,
    rows: Rows,
    options: IdentifyOptions,
    kernel: Kernel,
) -> tuple[IdentifiedRobot, RobotRecording]:
    """Identify; where no uncertainty is stated, estimate variance components from the residuals and do so again."""
    subset = inputs.subset(rows)
    found = identify(robot, subset, recording.select(rows), options, kernel)
    for _ in range(0 if recording.stated else 2):
        factors = variance_factors(found, subset, recording.select(rows), recording.observations)
        observations = rescaled(recording.observations, factors)
        # points tell by their body how they scatter; what they carry, frames, follows the robot's residuals
        pairs = zip(recording.detailed, recording.observations, observations, strict=True)
        detailed = tuple(new if own is old else own for own, old, new in pairs)
        recording = replace(recording, observations=observations, detailed=detailed)
        found = identify(robot, subset, recording.select(rows), options, kernel)
    return found, recording


def variance_factors(
    found: IdentifiedRobot, inputs: PoseInputs, used: Sequence[RobotObservations], kinds: Sequence[RobotObservations]
) -> list[Array]:
    """Factor by which the variances of each kind are too small: (2,) position and rotation of frames, else (1,).

    Every group's sum of squares is set against its share of the redundancy, which is taken as even.
    """
    T = found.kernel.frames(found.full_theta, inputs)
    share = found.redundancy / max(found.redundancy + len(found.names), 1)
    factors: list[Array] = []
    remaining = list(used)
    for kind in kinds:
        mine = next((o for o in remaining if type(o) is type(kind)), None)
        if mine is None:
            factors.append(np.ones(2 if isinstance(kind, FrameObservations) else 1))
            continue
        remaining.remove(mine)
        keep = found.used[mine.pose]
        r, _ = mine.evaluate(T)
        white = np.linalg.solve(np.linalg.cholesky(mine.noise(T)), r[..., None])[..., 0][keep]
        groups = [white[:, :3], white[:, 3:]] if isinstance(kind, FrameObservations) else [white]
        factors.append(np.array([max(float(np.mean(g**2)) / max(share, 0.05), 1e-12) for g in groups]))
    return factors


def calibrated_robot(poses: Poses, inputs: PoseInputs, found: IdentifiedRobot, nominal: RobotModel) -> Calibrated:
    """The calibrated robot beside the nominal one in its best cell, with what predictions need."""
    return Calibrated(
        model=found.model,
        nominal=nominal,
        statics=found.options.statics,
        names=tuple(found.names),
        covariance=found.covariance,
        q=poses.q,
        tools=found.kernel.frames(found.full_theta, inputs),
        defaults=defaults_of(poses),
    )


def _result(found: IdentifiedRobot, rows: Rows) -> dict[str, Any]:
    return {
        "poses": len(rows),
        "parameters": len(found.names),
        "iterations": found.iterations,
        "condition": found.condition,
        "sigma0": found.sigma0,
        "seconds": found.seconds,
        "redundancy": found.redundancy,
        "p_value": found.p_value,
        "eliminated": {
            name: {"reason": e.reason, "tied_to": [n for n, share in e.tied_to.items() if abs(share) > 0.05]}
            for name, e in found.eliminated.items()
        },
        "outliers": len(found.outliers),
        "correlated": [list(pair) for pair in found.strong_correlations()[:20]],
    }


def _notes(found: IdentifiedRobot, poses: Poses, rows: Rows) -> list[str]:
    notes = []
    for i in found.outliers:
        name, error = poses.names[int(rows[i])], found.normalised[i]
        notes.append(f"pose '{name}' contradicts all others and was left out (normalised error {error:.1f})")
    if not found.summary.converged:
        notes.append(f"the identification did not converge: {found.summary.termination}")
    return notes


def load_identification(run: Run) -> Identification:
    """Result of the stage."""
    found: Identification = run.load(NAME)
    return found


STAGE = Stage(
    name=NAME,
    applies=lambda campaign: campaign.robot is not None and campaign.poses is not None,
    work=work,
    inputs=lambda campaign: [
        p for p in campaign.files if p.suffix.lower() in {".csv", ".yaml", ".yml", ".urdf", ".xml"}
    ],
    settings=lambda campaign: campaign.entry.model_dump(include={"robot", "model", "payloads", "measurements", "body"}),
    after=("survey", "measure", "frames"),
    module=__name__,
)

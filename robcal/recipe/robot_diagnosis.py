"""The diagnosis of an identified robot: what it starts from, and the robot and measurements that it leaves behind.

Measurements freed of what the diagnosis found in the measuring system: a verification speaks of the robot.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from robcal.calibration.calibrated import CalibratedRobot, with_folded_cell
from robcal.calibration.cell import with_fitted_cell
from robcal.calibration.identifiability import weak_parameters
from robcal.calibration.identification import IdentifiedRobot
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import RobotObservations, RobotRecording, Rows, evenly_weighted
from robcal.calibration.observations import DistanceObservations, FrameObservations, PointObservations
from robcal.diagnosis.core.fitting import Accepted, Fit, fit
from robcal.diagnosis.core.recording import Recording, observation_data
from robcal.diagnosis.core.result import Diagnosis
from robcal.diagnosis.diagnose import diagnose
from robcal.diagnosis.images.diagnosis import ImageFinding
from robcal.diagnosis.noise.components import estimate_noise
from robcal.diagnosis.noise.swaps import find_swaps, relabelled
from robcal.diagnosis.search.selection import SelectionSettings
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.photogrammetry.station.network import StationOrientation
from robcal.physics.cause import DEVIATION, ObservationCause
from robcal.recipe.confirmation import confirmed, unlike_table, with_force
from robcal.recipe.evidence import Evidence, evidence_of
from robcal.recipe.identification import Identification
from robcal.recipe.image_findings import ImageFindings
from robcal.recipe.in_force import Form, InForce, choose
from robcal.recipe.lack_of_fit import missing_joint_sigma
from robcal.recipe.noise import noise_of
from robcal.recipe.order import covariance_without_order, placed, without_order
from robcal.recipe.recording import recording_for_diagnosis
from robcal.robot.kernel_cache import kernel_of
from robcal.transforms import Array, retract

MEASURING = ("camera", "wire", "sensor")
"""Stages whose causes displace what is measured; those of the body are judged by the frames already."""


def corrected(
    recording: RobotRecording, log: JointLog, diagnosis: Diagnosis, moves: bool = True
) -> RobotRecording | None:
    """The recording without the displacements found in the measuring system; None where there are none.

    ``moves`` : whether those that follow the order of the poses are still in it.
    Weakness: displaced targets of a body and exchanged ids are not corrected in frames.
    """
    found = [
        (f, f.cause)
        for f in diagnosis.findings
        if isinstance(f.cause, ObservationCause) and f.cause.stage in MEASURING and (moves or not f.cause.of_order)
    ]
    if not found:
        return None
    kernel = kernel_of(diagnosis.model, "converged")

    def displaced(o: RobotObservations) -> RobotObservations:
        rows = Recording(log.q, log.payload, log.recorded(), log.names, o)
        inputs = rows.inputs(kernel)
        data = observation_data(rows, kernel.frames(kernel.theta0, inputs), kernel.variables(kernel.theta0, inputs))
        shifts = (cause.observation_shift(data, f.constants) @ f.values for f, cause in found)
        shift = sum(shifts, np.zeros(()))
        if isinstance(o, FrameObservations):
            return dataclasses.replace(o, world_T_tool=retract(o.world_T_tool, -shift))
        if isinstance(o, DistanceObservations):
            return dataclasses.replace(o, distance=o.distance - shift.reshape(-1))
        return dataclasses.replace(o, p_world=o.p_world - shift)

    observations, detailed = (
        tuple(displaced(o) for o in some) for some in (recording.observations, recording.detailed)
    )
    return dataclasses.replace(recording, observations=observations, detailed=detailed)


BEYOND_DOUBT = 1e-6


@dataclass(frozen=True)
class Measured:
    """What was measured of the robot beside the observations: carried body, points, own station where there is one."""

    body: Body | None = None
    points: MeasuredPoints | None = None
    station: StationOrientation | None = None

    def recording(self, log: JointLog, measurements: RobotRecording, rows: Rows) -> Recording | None:
        """The measurements of some rows of the joint log as the diagnosis takes them; None where there are none."""
        if not len(rows):
            return None
        return recording_for_diagnosis(log, measurements, rows, self.body, self.points, self.station)


@dataclass(frozen=True)
class RobotDiagnosis:
    """What a diagnosis of the robot leaves behind.

    Attributes
    ----------
    recording : what was diagnosed.
    in_force : whether the robot with what was found is delivered, and why.
    robot : the robot in force.
    relative : (p, p) covariance of its parameters against frames of the own station; None without one.
    corrected : the measurements without the faults of the measuring system that the robot was fitted beside, if any.
    placed : the measurements without what follows the order of the poses, which the robot speaks of; None where nothing
        does.
    evidence : what every pose says of each cause.
    """

    diagnosis: Diagnosis
    recording: Recording = field(repr=False)
    in_force: InForce
    robot: CalibratedRobot = field(repr=False)
    relative: Array | None = field(repr=False)
    corrected: RobotRecording | None = field(repr=False)
    placed: RobotRecording | None = field(repr=False)
    evidence: Evidence = field(repr=False)


def diagnose_robot(
    found: Identification,
    log: JointLog,
    measured: Measured | None = None,
    images: ImageFindings | None = None,
    settings: SelectionSettings | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> RobotDiagnosis | None:
    """Diagnose an identified robot; verification poses only measure the gain. None where nothing can be diagnosed."""
    robot = found.robot
    measured, settings = measured or Measured(), settings or SelectionSettings()
    # all of them: what a few poses have against the others may be a blunder, or an effect of one place in the workspace
    recording = measured.recording(log, found.recording, found.rows)
    verify = measured.recording(log, found.recording, found.kept_out(log))
    if recording is None:
        return None
    free, tied = robot.names, (*robot.eliminated, *own_elasticities(robot))
    if recording.own_station:
        # told apart from the errors of the station, the frames show elasticities that were lost in them
        free, tied = (*robot.names, *own_elasticities(robot)), tuple(robot.eliminated)
    uncorrected = [] if images is None else [f for f in images.findings if f not in images.corrected]
    diagnosis = diagnose(
        robot.model,
        recording,
        free,
        tied,
        verify,
        settings_beside(settings, uncorrected),
        tell,
        optional_parameters(robot),
    )
    swapped = any(f.cause.kind.is_relabelling for f in diagnosis.findings)
    clean = relabelled(recording, find_swaps(recording)) if swapped else recording
    kept = ~np.isin(np.array(clean.names), diagnosis.blunders)
    clean, rows = clean.subset(kept), found.rows[kept]
    bare, extended = Form(robot.model, free), Form(diagnosis.model, diagnosis.free, _displacements(diagnosis))
    if diagnosis.findings:
        diagnosis, extended = confirmed(diagnosis, clean, log, rows, extended)
    in_force = InForce(bare, False, float("nan"), float("nan"), "nothing was found")
    if diagnosis.findings:
        in_force = choose(clean, log, rows, bare, extended)
    if not in_force.diagnosed:
        used = robot.used[kept]  # poses that the identification left out
        clean, rows = clean.subset(used), rows[used]
    delivered, relative, put, final = robot_in_force(found, log, clean, rows, in_force.form)
    findings = with_force(diagnosis.findings, in_force, final)
    diagnosis = replace(diagnosis, findings=findings, notes=(*diagnosis.notes, *unlike_table(findings)))
    if not in_force.diagnosed and not recording.own_station:
        delivered = found.robot  # as it was identified, so that nothing is worse than without a diagnosis
    least = estimate_noise(extended.model, clean, extended.free, extended.direct).factor
    delivered = with_lack_of_fit(delivered, found, log, clean, rows, in_force.form, least)
    return RobotDiagnosis(
        diagnosis=diagnosis,
        recording=recording,
        in_force=in_force,
        robot=delivered,
        relative=relative,
        corrected=corrected(put or found.recording, log, diagnosis, put is None) if in_force.form.direct else None,
        placed=put,
        evidence=evidence_of(robot.model, recording, free, verify, diagnosis),
    )


def robot_in_force(
    found: Identification, log: JointLog, recording: Recording, rows: Rows, form: Form
) -> tuple[CalibratedRobot, Array | None, RobotRecording | None, Fit]:
    """All parameters and terms of a model once more together, with base and tool in the datum of the measurements.

    A robot that is fitted beside the errors of its own station is better than one from its frames alone; what those
    errors displace all frames by is no part of the robot, so base and tool follow from the frames as they were measured
    and as a table of poses states them. Terms that follow the order of the poses stay with the recording.

    Parameters
    ----------
    recording, rows : the poses to fit to, and their rows in the joint log.

    Returns
    -------
    The robot; (p, p) the covariance of its parameters where errors common to all poses are known, None where there are
    none; the measurements without what follows the order of the poses, None where nothing does; the fit itself.
    """
    noise = estimate_noise(form.model, recording, form.free, form.direct)
    final = form.fit(noise.apply(recording))
    p, relative = len(final.free), None
    if recording.own_station and final.common is not None:
        known = fit(final.model, replace(noise.apply(recording), common=None), form.free, form.direct, iterations=0)
        relative = known.covariance[:p, :p] * final.variance_factor
        _, relative = covariance_without_order(final.model, final.free, relative)
    put = placed(found.recording, log, final)
    names, covariance = covariance_without_order(
        final.model, final.free, final.covariance[:p, :p] * final.variance_factor
    )
    robot = CalibratedRobot(
        model=with_folded_cell(without_order(final.model)),
        names=names,
        covariance=covariance,
        covariance_scale=noise.factor,
        joint_sigma=noise.joint_sigma,
        statics="converged",  # as the diagnosis fits
    )
    if recording.observations_are_spatial:
        joint = noise.joint_sigma / np.sqrt(noise.factor)
        stated = log.as_stated().inputs(robot.kernel).subset(rows)
        measured = (put or found.recording).select(rows)
        if recording.own_station:
            joint = 0.0
            measured = tuple(evenly_weighted(o) if isinstance(o, FrameObservations) else o for o in measured)
        robot = replace(robot, model=with_fitted_cell(robot.kernel, stated, measured, joint))
    nominal = found.robot.nominal
    robot = robot if nominal is None else robot.with_recording(log, nominal)
    return robot, relative, put, final


def undiagnosed(found: Identification, log: JointLog, measured: Measured) -> CalibratedRobot:
    """The identified robot where nothing is diagnosed, with what kept-out folds show beyond its parameters."""
    robot, recording = found.robot, measured.recording(log, found.recording, found.rows)
    if recording is None or recording.own_station:
        return robot
    recording, form = recording.subset(robot.used), Form(robot.model, robot.names)
    least = estimate_noise(form.model, recording, form.free).factor
    return with_lack_of_fit(robot, found, log, recording, found.rows[robot.used], form, least)


def with_lack_of_fit(
    robot: CalibratedRobot,
    found: Identification,
    log: JointLog,
    recording: Recording,
    rows: Rows,
    form: Form,
    least: float,
) -> CalibratedRobot:
    """The robot with what poses kept out show beyond its parameters, beside what the measurement itself scatters by.

    An own station's frames share errors that are told apart already. ``least`` : factor on the stated variances that is
    left with everything that was found and the recording knows, which bounds the measurement's.
    """
    if recording.own_station:
        return robot
    noise = estimate_noise(form.model, recording, form.free, form.direct)
    parts = noise_of(found, robot, log)
    scale = noise.factor
    if parts.source != "none" and isinstance(recording.observations, FrameObservations | PointObservations):
        said = np.trace(recording.observations.covariance[:, :3, :3], axis1=1, axis2=2)
        scale = min(float(parts.measurement**2 / np.mean(said)), least)
    plain = replace(recording, common=None)
    fitted = form.fit(noise.apply(plain))
    inputs = log.as_stated().inputs(fitted.kernel).subset(rows)
    joint = missing_joint_sigma(plain, fitted, inputs, scale)
    return robot if joint is None else replace(robot, joint_sigma=joint.tolist(), covariance_scale=scale)


def own_elasticities(found: IdentifiedRobot) -> tuple[str, ...]:
    """Elasticities about joints' own axes that the identification left out for want of evidence.

    They belong to the standard model, so they are no missing physics; the diagnosis frees them with the first cause.
    """
    if found.options.parameters != "standard":
        return ()
    own = {joint.elastic_name for joint in found.model.joints if not joint.prismatic}
    return tuple(name for name in found.rejected_elasticities if name in own)


def optional_parameters(found: IdentifiedRobot) -> tuple[str, ...]:
    """What the identification of a standard model took only because the residuals asked for it.

    Elasticities across joints' axes, and geometry that is less certain than anybody would doubt it anyway: that one was
    opened for what nothing plausible explained.
    """
    if found.options.parameters != "standard":
        return ()
    own = {joint.elastic_name for joint in found.model.joints if not joint.prismatic}
    cross = tuple(name for name in found.names if ".elastic_" in name and name not in own)
    frames = {frame.name for frame in found.model.frames}
    free = [name.rsplit(".", 1)[0] in frames and ".elastic_" not in name for name in found.names]
    limits = np.where(free, DEVIATION, np.inf)
    return (*cross, *weak_parameters(found.names, found.covariance, limits))


def settings_beside(settings: SelectionSettings, findings: Sequence[ImageFinding]) -> SelectionSettings:
    """Settings beside causes in images that displace what is measured and are not taken back.

    What they leave in the frames looks like small causes of the robot; only what is far beyond doubt is told.
    """
    if any(finding.kind.displaces_marks for finding in findings):
        return replace(settings, level=min(settings.level, BEYOND_DOUBT))
    return settings


def _displacements(diagnosis: Diagnosis) -> tuple[Accepted, ...]:
    """Causes that displace what is measured: they stand beside the model, all others are in it."""
    return tuple(
        Accepted(f.cause, f.constants, f.values, f.covariance)
        for f in diagnosis.findings
        if isinstance(f.cause, ObservationCause) and not f.cause.kind.is_relabelling
    )

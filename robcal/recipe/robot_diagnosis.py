"""The diagnosis of an identified robot: what it starts from, and the robot and measurements that it leaves behind."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from robcal.calibration.calibrated import CalibratedRobot, with_folded_cell
from robcal.calibration.identifiability import weak_parameters
from robcal.calibration.identification import IdentifiedRobot
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import RobotRecording, Rows
from robcal.diagnosis.core.fitting import Accepted, Fit, fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.core.result import Diagnosis
from robcal.diagnosis.diagnose import diagnose
from robcal.diagnosis.images.diagnosis import ImageFinding
from robcal.diagnosis.search.selection import SelectionSettings
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.photogrammetry.station.network import StationOrientation
from robcal.physics.cause import ObservationCause
from robcal.physics.prior_scale import DEVIATION
from robcal.recipe.corrections import corrected
from robcal.recipe.evidence import Evidence, evidence_of
from robcal.recipe.identification import Identification
from robcal.recipe.image_findings import ImageFindings
from robcal.recipe.recording import recording_for_diagnosis
from robcal.transforms import Array

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
    robot : the robot in force.
    relative : (p, p) covariance of its parameters beside frames that are freed of the station's errors.
    corrected : the measurements without what was found in the measuring system; None where nothing was.
    evidence : what every pose says of each cause.
    """

    diagnosis: Diagnosis
    recording: Recording = field(repr=False)
    robot: CalibratedRobot = field(repr=False)
    relative: Array | None = field(repr=False)
    corrected: RobotRecording | None = field(repr=False)
    evidence: Evidence = field(repr=False)


def diagnose_robot(
    found: Identification,
    log: JointLog,
    measured: Measured,
    images: ImageFindings,
    settings: SelectionSettings,
    tell: Callable[[str], None] = lambda text: None,
) -> RobotDiagnosis | None:
    """Diagnose an identified robot; verification poses only measure the gain. None where nothing can be diagnosed."""
    robot = found.robot
    # all of them: what a few poses have against the others may be a blunder, or an effect of one place in the workspace
    recording = measured.recording(log, found.recording, found.rows)
    verify = measured.recording(log, found.recording, found.kept_out(log))
    if recording is None:
        return None
    free, tied = robot.names, (*robot.eliminated, *own_elasticities(robot))
    if recording.own_station:
        # told apart from the errors of the station, the frames show elasticities that were lost in them
        free, tied = (*robot.names, *own_elasticities(robot)), tuple(robot.eliminated)
    uncorrected = [f for f in images.findings if f not in images.corrected]
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
    final = _final(diagnosis, recording)
    shared = None if measured.station is None else final.common
    calibrated, relative = replace_model(robot, diagnosis, shared is not None), None
    of_station = None
    if shared is not None:
        # beside frames that are freed of the station's errors, the robot is as uncertain as if there were none
        relative = _relative_covariance(diagnosis, recording) * final.variance_factor
        whole = measured.recording(log, found.recording, found.recording.poses)
        of_station = None if whole is None or whole.common is None else whole.common @ shared
    return RobotDiagnosis(
        diagnosis=diagnosis,
        recording=recording,
        robot=calibrated,
        relative=relative,
        corrected=corrected(found.recording, log, diagnosis, of_station),
        evidence=evidence_of(robot.model, recording, free, verify, diagnosis),
    )


def replace_model(found: IdentifiedRobot, diagnosis: Diagnosis, beside_station: bool) -> CalibratedRobot:
    """The robot in force after a diagnosis.

    A robot that was fitted beside the errors of its station is better even where nothing is missing.
    """
    robot = CalibratedRobot(
        model=found.model,
        names=found.names,
        covariance=found.covariance,
        covariance_scale=found.covariance_scale,
        joint_sigma=diagnosis.joint_sigma,
        statics=found.statics,
        nominal=found.nominal,
        q=found.q,
        tools=found.tools,
        defaults=found.defaults,
    )
    if not (diagnosis.findings or beside_station):
        return robot
    return replace(
        robot,
        model=with_folded_cell(diagnosis.model),
        names=diagnosis.free,
        covariance=diagnosis.covariance,
        statics="converged",  # as the diagnosis fits
    )


def own_elasticities(found: IdentifiedRobot) -> tuple[str, ...]:
    """Elasticities about joints' own axes that the identification left out for want of evidence.

    They belong to the standard model, so they are no missing physics; the diagnosis frees them with the first cause.
    """
    if found.options.parameters != "standard":
        return ()
    own = {f"{joint.name}.elastic_{joint.joint_kind}" for joint in found.model.joints if not joint.prismatic}
    return tuple(name for name in found.rejected_elasticities if name in own)


def optional_parameters(found: IdentifiedRobot) -> tuple[str, ...]:
    """What the identification of a standard model took only because the residuals asked for it.

    Elasticities across joints' axes, and geometry that is less certain than anybody would doubt it anyway: that one was
    opened for what nothing plausible explained.
    """
    if found.options.parameters != "standard":
        return ()
    own = {f"{joint.name}.elastic_{joint.joint_kind}" for joint in found.model.joints if not joint.prismatic}
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


def _relative_covariance(diagnosis: Diagnosis, recording: Recording) -> Array:
    """Covariance (p, p) of the free parameters where errors common to all poses are known, variance factor one."""
    known = _final(diagnosis, replace(recording, common=None), iterations=0)
    return known.covariance[: len(diagnosis.free), : len(diagnosis.free)]


def _final(diagnosis: Diagnosis, recording: Recording, iterations: int = 8) -> Fit:
    """The extended model at the recording: its terms are in the model, observation causes beside it."""
    direct = [
        Accepted(f.cause, f.constants, f.values, f.covariance)
        for f in diagnosis.findings
        if isinstance(f.cause, ObservationCause)
    ]
    clean = recording.subset(~np.isin(np.array(recording.names), diagnosis.blunders))
    return fit(diagnosis.model, clean, diagnosis.free, direct, iterations=iterations)

"""What the stages of a run hand on: name, type and maker of every stored result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:  # a stage depends on the types that it uses, not on those of all others
    from collections.abc import Mapping, Sequence

    from pipeline.detected_images import DetectionIndex
    from pipeline.stages.hand_eye import HandEyeRun
    from robcal.calibration.calibrated import CalibratedRobot
    from robcal.calibration.instruments import IdentifiedInstruments
    from robcal.calibration.measurements import RobotRecording, Rows
    from robcal.calibration.verification import Verification
    from robcal.diagnosis.images.diagnosis import ImageFinding
    from robcal.imaging.detections import Detections
    from robcal.photogrammetry.core.bodies import Body
    from robcal.photogrammetry.measure.frames import MeasuredFrames
    from robcal.photogrammetry.measure.measured_points import MeasuredPoints
    from robcal.photogrammetry.station.network import StationMarks, StationOrientation
    from robcal.photogrammetry.station.seen_normals import Ellipses
    from robcal.photogrammetry.survey.types import SurveyResult
    from robcal.recipe.evidence import Evidence
    from robcal.recipe.identification import Identification
    from robcal.recipe.joint import JointlyAdjusted
    from robcal.recipe.verification import RobotVerification
    from robcal.transforms import Array

T = TypeVar("T")


@dataclass(frozen=True)
class Artifact(Generic[T]):
    """A stored result of type T: its file is ``cache/<name>.npz``; ``stage`` makes it."""

    name: str
    stage: str


DETECTED: Artifact[DetectionIndex] = Artifact("detect", "detect")
ORIENTATION: Artifact[StationOrientation] = Artifact("orient", "orient")
MARKS: Artifact[Mapping[str, StationMarks]] = Artifact("marks", "orient")
SHAPES: Artifact[Mapping[str, Ellipses]] = Artifact("shapes", "orient")
"""Ellipses and light of the marks, by camera."""
CORRECTED_IMAGES: Artifact[Sequence[ImageFinding]] = Artifact("corrected_images", "orient")
"""Findings that the station was oriented without (sizes of dots, centres that trail behind light)."""
POINTS: Artifact[MeasuredPoints] = Artifact("points", "measure")
FRAMES: Artifact[MeasuredFrames] = Artifact("frames", "frames")
IDENTIFICATION: Artifact[Identification] = Artifact("identify", "identify")
IDENTIFIED: Artifact[CalibratedRobot] = Artifact("identified", "identify")
"""The identified robot as it is delivered where nothing is diagnosed."""
INSTRUMENTS: Artifact[IdentifiedInstruments] = Artifact("instruments", "identify")
"""Where a campaign has several instruments, or one of whose world or tool something is known."""
DIAGNOSED_INSTRUMENTS: Artifact[IdentifiedInstruments] = Artifact("diagnosed_instruments", "diagnose")
"""All instruments identified anew beside what a diagnosis found."""
CALIBRATED: Artifact[CalibratedRobot] = Artifact("calibrated", "diagnose")
"""The robot in force after the diagnosis."""
EVIDENCE: Artifact[Evidence] = Artifact("evidence", "diagnose")
CORRECTED: Artifact[RobotRecording] = Artifact("corrected", "diagnose")
"""The recording without what was found in the measuring system."""
PLACED: Artifact[RobotRecording] = Artifact("placed", "diagnose")
"""The recording in the frame of its first pose, where the station or the base moved or a zero jumped."""
DELIVERED: Artifact[RobotVerification] = Artifact("delivered", "diagnose")
"""The verification of the robot in force."""
ADJUSTED: Artifact[JointlyAdjusted] = Artifact("adjusted", "adjust")
"""The robot in force from one adjustment of marks, cameras, body and robot."""
HAND_EYE: Artifact[HandEyeRun] = Artifact("hand_eye", "hand_eye")
RELATIVE_COVARIANCE: Artifact[Array] = Artifact("relative", "diagnose")
"""Covariance (p, p) of the robot's parameters where the errors of the station are known."""
VERIFICATION: Artifact[tuple[Verification, Rows]] = Artifact("verify", "verify")
"""The verification and the rows (n,) of its poses in the joint log."""


def detections(key: str) -> Artifact[Detections]:
    """Targets found in one image, by a hash of its content and the settings."""
    return Artifact(f"detections/{key}", "detect")


def survey(body: str) -> Artifact[SurveyResult]:
    """The bundle adjustment of a body."""
    return Artifact(f"survey_{body}", "survey")


def surveyed_body(name: str) -> Artifact[Body]:
    """A body with its surveyed coordinates."""
    return Artifact(f"body_{name}", "survey")

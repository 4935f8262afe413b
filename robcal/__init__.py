"""From photographs or tracker data to an accurate robot: the names that a program or a notebook needs.

Arrays and typed results; SI units and radians inside; ``a_T_b`` takes coordinates of frame b to frame a. Files of
people (``read_...``) are in millimetres and degrees. What is imported from here is stable; modules behind it may move.

A robot from two tables, with what its model lacks::

    import robcal

    model = robcal.read_any_robot("robot.yaml")
    log = robcal.read_joint_log("poses.csv", model)
    found = robcal.identify_robot(model, log, robcal.read_recording("frames.csv", log))
    diagnosis = robcal.diagnose_robot(found, log)
    robot = diagnosis.robot if diagnosis else found.robot
    T, covariance = robot.predict(robot.inputs(log))
    robcal.write_robot("robot_calibrated.yaml", robot.model)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # loaded when first asked for: importing robcal takes milliseconds
    from robcal.calibration.calibrated import CalibratedRobot as CalibratedRobot
    from robcal.calibration.identification import IdentifiedRobot as IdentifiedRobot
    from robcal.calibration.identification import IdentifyOptions as IdentifyOptions
    from robcal.calibration.identification import identify as identify
    from robcal.calibration.joint_log import JointLog as JointLog
    from robcal.calibration.measurements import RobotRecording as RobotRecording
    from robcal.calibration.observations import DistanceObservations as DistanceObservations
    from robcal.calibration.observations import FrameObservations as FrameObservations
    from robcal.calibration.observations import Observations as Observations
    from robcal.calibration.observations import PixelObservations as PixelObservations
    from robcal.calibration.observations import PointObservations as PointObservations
    from robcal.calibration.observations import SensorPointObservations as SensorPointObservations
    from robcal.calibration.verification import Verification as Verification
    from robcal.diagnosis.core.result import Diagnosis as Diagnosis
    from robcal.errors import DegenerateGeometry as DegenerateGeometry
    from robcal.errors import InvalidInput as InvalidInput
    from robcal.errors import NotIdentifiable as NotIdentifiable
    from robcal.errors import RobcalError as RobcalError
    from robcal.files.body_file import body_from_file as body_from_file
    from robcal.files.body_file import read_body as read_body
    from robcal.files.camera_file import read_camera as read_camera
    from robcal.files.images import read_image as read_image
    from robcal.files.recordings import read_joint_log as read_joint_log
    from robcal.files.recordings import read_recording as read_recording
    from robcal.files.robot_file import write_robot as write_robot
    from robcal.files.robot_import import read_any_robot as read_any_robot
    from robcal.imaging.detect import detect_targets as detect_targets
    from robcal.imaging.detections import Detections as Detections
    from robcal.imaging.settings import DetectionSettings as DetectionSettings
    from robcal.photogrammetry.core.bodies import Body as Body
    from robcal.photogrammetry.core.camera import Camera as Camera
    from robcal.photogrammetry.core.network import Lengths as Lengths
    from robcal.photogrammetry.measure.frames import MeasuredFrames as MeasuredFrames
    from robcal.photogrammetry.measure.frames import measure_frames as measure_frames
    from robcal.photogrammetry.measure.measured_points import MeasuredPoints as MeasuredPoints
    from robcal.photogrammetry.measure.points import measure_points as measure_points
    from robcal.photogrammetry.station.network import StationMarks as StationMarks
    from robcal.photogrammetry.station.network import StationOrientation as StationOrientation
    from robcal.photogrammetry.station.network import StationSettings as StationSettings
    from robcal.photogrammetry.station.orientation import orient_station as orient_station
    from robcal.photogrammetry.survey.survey import survey_body as survey_body
    from robcal.photogrammetry.survey.types import BodyTarget as BodyTarget
    from robcal.photogrammetry.survey.types import SurveyImage as SurveyImage
    from robcal.photogrammetry.survey.types import SurveyResult as SurveyResult
    from robcal.recipe.identification import Identification as Identification
    from robcal.recipe.identification import identify_robot as identify_robot
    from robcal.recipe.robot_diagnosis import RobotDiagnosis as RobotDiagnosis
    from robcal.recipe.robot_diagnosis import diagnose_robot as diagnose_robot
    from robcal.recipe.verification import RobotVerification as RobotVerification
    from robcal.recipe.verification import verify_robot as verify_robot
    from robcal.robot.compensation import Compensation as Compensation
    from robcal.robot.compensation import compensate as compensate
    from robcal.robot.dh import DHRow as DHRow
    from robcal.robot.dh import frames_from_dh as frames_from_dh
    from robcal.robot.export.c_export import CSource as CSource
    from robcal.robot.export.c_export import export_c as export_c
    from robcal.robot.export.urdf import urdf_text as urdf_text
    from robcal.robot.kernel import Kernel as Kernel
    from robcal.robot.kernel import PoseInputs as PoseInputs
    from robcal.robot.model import Frame as Frame
    from robcal.robot.model import Payload as Payload
    from robcal.robot.model import RobotModel as RobotModel
    from robcal.robot.model import Term as Term

_HOMES = {
    "calibration.calibrated": "CalibratedRobot",
    "calibration.identification": "IdentifiedRobot IdentifyOptions identify",
    "calibration.joint_log": "JointLog",
    "calibration.measurements": "RobotRecording",
    "calibration.observations": "DistanceObservations FrameObservations Observations PixelObservations "
    "PointObservations SensorPointObservations",
    "calibration.verification": "Verification",
    "diagnosis.core.result": "Diagnosis",
    "errors": "DegenerateGeometry InvalidInput NotIdentifiable RobcalError",
    "files.body_file": "body_from_file read_body",
    "files.camera_file": "read_camera",
    "files.images": "read_image",
    "files.recordings": "read_joint_log read_recording",
    "files.robot_file": "write_robot",
    "files.robot_import": "read_any_robot",
    "imaging.detect": "detect_targets",
    "imaging.detections": "Detections",
    "imaging.settings": "DetectionSettings",
    "photogrammetry.core.network": "Lengths",
    "photogrammetry.core.bodies": "Body",
    "photogrammetry.core.camera": "Camera",
    "photogrammetry.measure.frames": "MeasuredFrames measure_frames",
    "photogrammetry.measure.measured_points": "MeasuredPoints",
    "photogrammetry.measure.points": "measure_points",
    "photogrammetry.station.network": "StationMarks StationOrientation StationSettings",
    "photogrammetry.station.orientation": "orient_station",
    "photogrammetry.survey.survey": "survey_body",
    "photogrammetry.survey.types": "BodyTarget SurveyImage SurveyResult",
    "recipe.identification": "Identification identify_robot",
    "recipe.robot_diagnosis": "RobotDiagnosis diagnose_robot",
    "recipe.verification": "RobotVerification verify_robot",
    "robot.compensation": "Compensation compensate",
    "robot.dh": "DHRow frames_from_dh",
    "robot.export.c_export": "CSource export_c",
    "robot.export.urdf": "urdf_text",
    "robot.kernel": "Kernel PoseInputs",
    "robot.model": "Frame Payload RobotModel Term",
}
_MODULE_OF = {name: f"robcal.{module}" for module, names in _HOMES.items() for name in names.split()}
__all__ = ["__version__", *sorted(_MODULE_OF)]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib import metadata

        return metadata.version("robcal")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'robcal' has no attribute '{name}'")
    value = globals()[name] = getattr(import_module(_MODULE_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

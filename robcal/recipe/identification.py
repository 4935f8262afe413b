"""From a joint log and measurements to an identified robot, with the checks that a recording needs."""

from dataclasses import dataclass, field, replace

import numpy as np

from robcal.calibration.identification import IdentifiedRobot, IdentifyOptions
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import RobotRecording, Rows
from robcal.calibration.recording_errors.search import check_failed_fit, check_joint_log
from robcal.calibration.variance_components import identify_recording
from robcal.calibration.verification import fit_nominal
from robcal.errors import InvalidInput
from robcal.robot.kernel import Kernel
from robcal.robot.model import RobotModel


@dataclass(frozen=True)
class Identification:
    """An identified robot and what it was identified from.

    Attributes
    ----------
    rows : (n,) rows in the joint log of the poses that were identified from.
    robot : with the nominal robot in its best cell beside it.
    recording : the measurements, with the uncertainty estimated where none was stated.
    """

    rows: Rows
    robot: IdentifiedRobot = field(repr=False)
    recording: RobotRecording = field(repr=False)

    @property
    def sound(self) -> Rows:
        """Rows (k,) of the poses that were identified from, without those that were left out as blunders."""
        return self.rows[self.robot.used]

    def kept_out(self, log: JointLog) -> Rows:
        """Rows (k,) of measured poses that took no part."""
        return np.array([i for i in self.recording.poses if log.verify[i]], dtype=np.int64)


def identify_robot(
    model: RobotModel, log: JointLog, recording: RobotRecording, options: IdentifyOptions | None = None
) -> Identification:
    """Identify a robot from the measured poses that are not kept out.

    Raises
    ------
    InvalidInput : no pose is left, or joint angles and measurements do not belong together.
    NotIdentifiable : fewer measurements than unknowns of base and tool.
    """
    rows = np.array([i for i in recording.poses if not log.verify[i]], dtype=np.int64)
    if not len(rows):
        raise InvalidInput("no measured pose is left to identify from: set 'identify' in the column set")
    options = options or IdentifyOptions()
    kernel = Kernel(model, options.statics)
    inputs = log.inputs(kernel)
    slips = check_joint_log(model, inputs, recording, kernel)
    start = model
    if slips:
        start = model.with_parameters({**model.parameters, **slips[0].values})
        kernel = Kernel(start, options.statics)
        recording = replace(recording, notes=(*recording.notes, f"{slips[0].statement}; {slips[0].remedy}"))
    found, recording = identify_recording(start, inputs, recording, rows, options, kernel)
    if recording.stated:
        check_failed_fit(model, inputs, recording, kernel, found)
    # what was left out as a blunder says nothing about the nominal robot either
    sound = rows[found.used]
    nominal = fit_nominal(model, inputs.subset(sound), recording.select(sound))
    return Identification(rows, found.with_recording(log, nominal.model), recording)

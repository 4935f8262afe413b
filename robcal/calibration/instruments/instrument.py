"""An instrument: what it measured, in which world, of which tool."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from robcal.calibration.closed_loops import PlaneObservations
from robcal.calibration.instruments.cell_frame import CellFrame
from robcal.calibration.measurements import RobotObservations, RobotRecording
from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    PointObservations,
    SensorPointObservations,
)

_KINDS: dict[type, tuple[str, int]] = {
    FrameObservations: ("frames", 6),
    PointObservations: ("points", 3),
    SensorPointObservations: ("sensor_points", 3),
    DistanceObservations: ("distances", 1),
    PlaneObservations: ("constraints", 1),
}


@dataclass(frozen=True)
class Instrument:
    """A measuring system in an identification.

    Attributes
    ----------
    recording : its measurements, by row of the joint log.
    world, tool : what is known of them; instruments that share one have the very same.
    wire : parameters of a draw-wire (:data:`robcal.calibration.wire.LIMITS`) that are identified with the robot.
    loop : kind of a closed loop ('point', 'plane', 'length') that takes the place of measurements; empty for all else.
    """

    name: str
    recording: RobotRecording = field(repr=False)
    world: CellFrame
    tool: CellFrame
    wire: tuple[str, ...] = ()
    loop: str = ""

    @property
    def kind(self) -> str:
        """'frames', 'points', 'sensor_points', 'distances' or 'constraints': the kind that tells most."""
        return "constraints" if self.loop else kind_of(self.recording.observations)[0]

    @property
    def dimension(self) -> int:
        """Numbers that one measurement tells of the tool: 6, 3 or 1; a closed loop counts least."""
        return 0 if self.loop else kind_of(self.recording.observations)[1]


def kind_of(observations: Sequence[RobotObservations]) -> tuple[str, int]:
    """Kind and dimension of the measurements that tell most."""
    return max((_KINDS[type(o)] for o in observations), key=lambda pair: pair[1])

"""What an identification with several instruments leaves: the robot, and how each instrument stands to it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.identification import IdentifiedRobot
from robcal.calibration.instruments.evaluator import kernel_ends
from robcal.calibration.instruments.instrument import Instrument
from robcal.calibration.measurements import RobotRecording, Rows
from robcal.robot.model import RobotModel
from robcal.transforms import Array, invert


@dataclass(frozen=True)
class PlacedInstrument:
    """One instrument after the identification.

    Attributes
    ----------
    instrument : what was known before, with its measurements weighted as the residuals showed.
    rows : (n,) rows in the joint log that it was identified from; empty if it verifies only.
    used : (n,) those that were not left out as blunders.
    sigma0, redundancy, p_value : of its own residuals against what it states; NaN if it verifies only.
    variance : factor by which its stated variances were raised, one if they hold.
    world_T_base, flange_T_tool : (4, 4).
    covariance : (12, 12) of right perturbations of both.
    held : coordinates that its measurements do not tell.
    nominal : the nominal robot in the best cell of this instrument.
    robot : the robot as this instrument sees it: base and tool are its own. None if it verifies only.
    wire : identified parameters of a draw-wire with their standard deviations (SI), by name.
    """

    instrument: Instrument
    rows: Rows
    used: NDArray[np.bool_]
    sigma0: float
    redundancy: float
    p_value: float
    variance: float
    world_T_base: Array = field(repr=False)
    flange_T_tool: Array = field(repr=False)
    covariance: Array = field(repr=False)
    held: tuple[str, ...]
    nominal: RobotModel = field(repr=False)
    robot: IdentifiedRobot | None = field(repr=False, default=None)
    wire: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def recording(self) -> RobotRecording:
        """Its measurements."""
        return self.instrument.recording

    @property
    def sound(self) -> Rows:
        """Rows without those that were left out."""
        return self.rows[self.used]


@dataclass(frozen=True)
class IdentifiedInstruments:
    """A robot identified from several instruments together.

    Attributes
    ----------
    placed : by name, in the order of the campaign.
    names, covariance : all fitted parameters (p,), those of worlds and tools as ``<instrument>.<base|tool>.<x..yaw>``,
        and their covariance (p, p).
    notes : what was assumed.
    """

    placed: Mapping[str, PlacedInstrument]
    names: tuple[str, ...]
    covariance: Array = field(repr=False)
    notes: tuple[str, ...] = ()

    @property
    def leading(self) -> str:
        """The instrument of the highest dimension among those identified from; of several, the one with most poses."""
        identified = [p for p in self.placed.values() if p.robot is not None]
        return max(identified, key=lambda p: (p.instrument.dimension, len(p.rows))).instrument.name

    @property
    def telling(self) -> str:
        """The instrument of the highest dimension of all: in its world predictions are made if nothing else is said."""
        found = self.placed.values()
        key = [(p.instrument.dimension, p.robot is not None, len(p.rows)) for p in found]
        return list(self.placed)[max(range(len(key)), key=lambda k: key[k])]

    def seen_by(self, name: str, robot: CalibratedRobot) -> CalibratedRobot:
        """A robot in the world and with the tool of an instrument.

        ``robot`` has the fitted parameters of this identification (or more): its base and tool are replaced.
        """
        placed = self.placed[name]
        model = replace(robot.model, world_T_base=placed.world_T_base, flange_T_tool=placed.flange_T_tool)
        names, covariance = joined_covariance(robot, placed.covariance)
        tools = robot.tools
        if tools is not None and robot.model.world_T_base is not None and robot.model.flange_T_tool is not None:
            base_T_flange = invert(robot.model.world_T_base) @ tools @ invert(robot.model.flange_T_tool)
            tools = placed.world_T_base @ base_T_flange @ placed.flange_T_tool
        return replace(robot, model=model, names=names, covariance=covariance, nominal=placed.nominal, tools=tools)


def joined_covariance(robot: CalibratedRobot, cell: Array) -> tuple[tuple[str, ...], Array]:
    """Names and covariance of a robot with base and tool of another instrument, ``cell`` (12, 12).

    Weakness: what base and tool have in common with the robot's parameters is not carried.
    """
    ends = kernel_ends()
    own = [k for k, n in enumerate(robot.names) if n not in ends]
    covariance = np.zeros((len(own) + 12, len(own) + 12))
    covariance[: len(own), : len(own)] = robot.covariance[np.ix_(own, own)]
    covariance[len(own) :, len(own) :] = cell
    return (*(robot.names[k] for k in own), *ends), covariance

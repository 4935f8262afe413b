"""Wires whose lengths are corrected from outside, by a function of the length and the direction to the robot.

The direction follows from the robot, so identification and correction are repeated until the lengths rest.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from robcal.calibration.identification import IdentifyOptions
from robcal.calibration.instruments import IdentifiedInstruments, Instrument, identify_instruments
from robcal.calibration.joint_log import JointLog
from robcal.calibration.observations import DistanceObservations
from robcal.recipe.instruments import identify_from_instruments, leading_identification
from robcal.robot.model import RobotModel
from robcal.transforms import Array

Correction = Callable[[float, Array], float]
"""Length (m) as it was read and direction (3,) in the wire's world to the length (m) of a straight wire."""

ROUNDS = 9
SETTLED = 1e-6
"""m; lengths that change by less rest."""


def identify_with_corrections(
    model: RobotModel,
    log: JointLog,
    instruments: Sequence[Instrument],
    corrections: Mapping[str, Correction],
    options: IdentifyOptions | None = None,
) -> IdentifiedInstruments:
    """As :func:`robcal.recipe.instruments.identify_from_instruments`, lengths of some wires corrected in turn.

    Raises
    ------
    InvalidInput, NotIdentifiable : as there.
    """
    found = identify_from_instruments(model, log, instruments, options)
    if not corrections:
        return found
    current, change, rounds = list(instruments), np.inf, 1
    while change > SETTLED and rounds < ROUNDS:
        following = [
            corrected(raw, found, log, corrections[raw.name]) if raw.name in corrections else raw for raw in instruments
        ]
        change = max(_change(a, b) for a, b in zip(current, following, strict=True))
        current = following
        found = identify_instruments(model, log, current, options)
        rounds += 1
    found = identify_from_instruments(model, log, current, options)
    message = f"lengths of {' and '.join(corrections)} corrected from outside in {rounds} rounds, they changed by "
    message += f"{1e3 * change:.2g} mm in the last one" + ("" if change <= SETTLED else ": they do not rest")
    return replace(found, notes=(*found.notes, message))


def corrected(raw: Instrument, found: IdentifiedInstruments, log: JointLog, correction: Correction) -> Instrument:
    """An instrument with its lengths corrected for the directions of an identified robot."""
    robot = found.seen_by(raw.name, leading_identification(found).robot)
    places = robot.predict(robot.inputs(log))[0][:, :3, 3]
    directions = places / np.linalg.norm(places, axis=1, keepdims=True)
    made = tuple(
        replace(
            o, distance=np.array([correction(float(d), directions[k]) for d, k in zip(o.distance, o.pose, strict=True)])
        )
        if isinstance(o, DistanceObservations)
        else o
        for o in raw.recording.observations
    )
    return replace(raw, recording=replace(raw.recording, observations=made, detailed=made))


def _change(a: Instrument, b: Instrument) -> float:
    pairs = zip(a.recording.observations, b.recording.observations, strict=True)
    steps = [
        np.abs(x.distance - y.distance).max()
        for x, y in pairs
        if isinstance(x, DistanceObservations) and isinstance(y, DistanceObservations)
    ]
    return float(max(steps, default=0.0))

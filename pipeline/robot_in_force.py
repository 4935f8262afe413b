"""The robot that a command works with: of a finished run, or of a drift control with the model in force."""

from pathlib import Path

from pipeline.runs import open_run
from pipeline.stages.identify import load_calibrated
from robcal.calibration.calibrated import CalibratedRobot
from robcal.errors import InvalidInput


def robot_in_force(place: Path, at_cycle: int | None = None, instrument: str | None = None) -> CalibratedRobot:
    """The calibrated robot of a run folder, or of the state of a drift control (a file, a URL).

    Raises
    ------
    InvalidInput : neither is there; ``at_cycle`` with a run, or ``instrument`` with a drift control.
    """
    from pipeline.drift.database import is_drift, transaction

    if not is_drift(place):
        if at_cycle is not None:
            raise InvalidInput(f"{place}: --at-cycle needs the state of a drift control, a run has no cycles")
        return load_calibrated(open_run(place), instrument)
    if instrument is not None:
        raise InvalidInput(f"{place}: --instrument needs a run, a drift control has one instrument")
    from pipeline.drift.store import robot_at

    with transaction(place) as connection:
        return robot_at(connection, at_cycle)

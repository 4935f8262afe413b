"""The diagnosis of a campaign with several instruments: from the run's identification to diagnosis.json."""

import math
from collections.abc import Mapping
from dataclasses import replace

from pipeline.artifacts import DIAGNOSED_INSTRUMENTS, INSTRUMENTS
from pipeline.json_io import write_json
from pipeline.messages import LOG
from pipeline.stages.base import Context, Outcome
from pipeline.stages.identify import options_of, require_robot
from pipeline.stages.observations import build_instruments, corrections_of
from robcal.calibration.instruments import PlacedInstrument
from robcal.calibration.verification import Verification
from robcal.diagnosis.of_instruments import Attributed, instruments_content
from robcal.diagnosis.search.selection import SelectionSettings
from robcal.recipe.instruments import verify_instruments
from robcal.recipe.instruments_diagnosis import ReportedCause, diagnose_instruments

STAGES: Mapping[str, str] = {"distances": "wire", "sensor_points": "sensor"}
"""Stage of the measuring chain by the kind of an instrument; of all others the camera."""


def diagnose_several(context: Context, settings: SelectionSettings) -> Outcome:
    """Diagnose all instruments; write diagnosis.json, and keep the robot that is identified beside what was found."""
    campaign, run = context.campaign, context.run
    robot, poses = require_robot(campaign)
    found = run.load(INSTRUMENTS)
    options = options_of(campaign, stated=True)
    given = build_instruments(campaign, run)
    corrections = corrections_of(campaign)
    done = diagnose_instruments(robot, found, given, poses, options, corrections, settings, LOG.info)
    if not done.own:
        return Outcome(notes=["nothing to diagnose"])
    leading = found.leading if found.leading in done.own else next(iter(done.own))
    run.artifact(DIAGNOSED_INSTRUMENTS).unlink(missing_ok=True)  # of a diagnosis before
    gain, outputs = None, [run.diagnosis]
    if done.reported:
        gain = (
            _kept_out(verify_instruments(robot, found, poses, options)),
            _kept_out(verify_instruments(robot, done.found, poses, options)),
        )
        outputs.append(run.save(DIAGNOSED_INSTRUMENTS, replace(done.found, notes=(*done.found.notes, *done.notes))))
    reported = [_attributed(t, done.found.placed) for t in done.reported]
    decided: dict[str, object] = {"in_force": done.in_force}
    if done.decided is not None:
        errors = {"identified": 1e3 * done.decided.identified, "diagnosed": 1e3 * done.decided.diagnosed_error}
        decided |= {"in_force_reason": done.decided.reason, "delivered_mm": errors}
    content = instruments_content(done.own, reported, leading, gain, done.not_separable) | decided
    write_json(run.diagnosis, content)
    statements = [t.statement for t in done.reported] or ["nothing missing: the model explains the data"]
    causes = [
        {"cause": t.finding.cause.name, "where": t.finding.cause.where, "direction": t.finding.cause.direction}
        | {"instrument": t.instrument}
        for t in done.reported
    ]
    result = {key: content[key] for key in ("mismatch", "p_value", "heldout_mm", "not_told")} | decided
    return Outcome({"diagnosis": result | {"causes": causes}}, outputs, [*statements, *done.not_separable, *done.notes])


def _attributed(reported: ReportedCause, placed: Mapping[str, PlacedInstrument]) -> Attributed:
    stage = str(reported.finding.cause.stage)
    if reported.contradicting:
        stage = STAGES.get(placed[reported.instrument].instrument.kind, "camera")
    return Attributed(
        reported.finding, reported.instrument, reported.agreeing, reported.contradicting, stage, reported.statement
    )


def _kept_out(verified: Mapping[str, Verification]) -> float:
    """RMS error (mm) of the instrument with the most dimensions at kept-out poses; NaN where none has any."""
    if not verified:
        return math.nan
    return 1e3 * max(verified.values(), key=lambda v: (len(v.tools), v.poses)).tools["0"].rms

"""Several instruments diagnosed: each by itself and against the others, and what they say of the robot together.

The instruments of the highest dimension are diagnosed with the robot as their own measurements tell it. Every other one
is judged against the robot that those identify, whose uncertainty counts as errors that all its measurements share. A
cause in a robot that one instrument shows and another contradicts belongs to the first instrument. Then the robot is
identified anew from all instruments, causes of the robot and parameters of wires together with it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from robcal.calibration.identification import IdentifyOptions
from robcal.calibration.instruments import IdentifiedInstruments, Instrument, PlacedInstrument, identify_instruments
from robcal.calibration.instruments.evaluator import kernel_ends
from robcal.calibration.joint_log import JointLog
from robcal.diagnosis.core.fitting import Accepted, fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.core.result import Diagnosis, Finding
from robcal.diagnosis.diagnose import diagnose
from robcal.diagnosis.noise.components import estimate_noise
from robcal.diagnosis.search.selection import SelectionSettings
from robcal.errors import RobcalError
from robcal.physics.cause import ObservationCause
from robcal.physics.measuring import WIRE_SCALE
from robcal.recipe.instruments_delivery import Anew, InstrumentsDiagnosis, ReportedCause, delivered
from robcal.recipe.recording import recording_for_diagnosis
from robcal.recipe.wire_alarms import scale_by_lengths
from robcal.recipe.wires import Correction
from robcal.robot.kernel_cache import kernel_of
from robcal.robot.model import RobotModel
from robcal.transforms import Array

CONTRADICTS = 1e-3
"""Probability of two instruments' amplitudes below which they contradict each other."""
SHOWS = 1e-3
"""Probability of no effect below which an instrument shows a cause, or would show it if it were there."""
KNOWN = 1e-4
"""m; a tool whose place is known to this carries the scale of a wire: it shows in the residuals."""


def diagnose_instruments(
    model: RobotModel,
    found: IdentifiedInstruments,
    instruments: Sequence[Instrument],
    log: JointLog,
    options: IdentifyOptions | None = None,
    corrections: Mapping[str, Correction] | None = None,
    settings: SelectionSettings | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> InstrumentsDiagnosis:
    """Diagnose every instrument that was identified from, and all together.

    Parameters
    ----------
    model : the nominal robot. found : identified from ``instruments``. corrections : as for the identification.
    """
    taking_part = {n: p for n, p in found.placed.items() if p.robot is not None and not p.instrument.loop}
    if not taking_part:
        return InstrumentsDiagnosis({}, (), found, model)
    best = max(p.instrument.dimension for p in taking_part.values())
    others = [p.instrument for p in taking_part.values() if p.instrument.dimension == best]
    own: dict[str, Diagnosis] = {}
    not_separable: list[str] = []
    cases: dict[str, _Case] = {}
    for name, placed in taking_part.items():
        against = others if placed.instrument.dimension < best else []
        case = _case(model, placed, log, against, options)
        if case is None:
            continue
        if case.recording.hidden and not _lengths_are_believed(options):
            not_separable.append(
                f"a wrong scale of wire '{name}' cannot be told: neither is its tool's place known nor do lengths of "
                "the robot have priors, and no instrument that measures more identifies the robot"
            )
        tell(f"instrument '{name}'")
        cases[name] = case
        own[name] = diagnose(case.model, case.recording, case.free, case.tied, None, settings or SelectionSettings())
    reported = [ReportedCause(f, name) for name, d in own.items() for f in d.findings]
    reported = _distinct([_compared(t, cases) for t in reported])
    reported += [
        t
        for n, c in cases.items()
        if c.recording.hidden and (t := _scale_of(n, c, model, found, log, options, reported))
    ]
    anew = Anew(model, found, instruments, log, options or IdentifyOptions(), corrections or {}, own)
    return delivered(anew, reported, tuple(not_separable))


@dataclass(frozen=True)
class _Case:
    """What the diagnosis of one instrument works on."""

    model: RobotModel
    recording: Recording
    free: tuple[str, ...]
    tied: tuple[str, ...]


def _case(
    model: RobotModel,
    placed: PlacedInstrument,
    log: JointLog,
    others: Sequence[Instrument],
    options: IdentifyOptions | None,
) -> _Case | None:
    robot = placed.robot
    recording = recording_for_diagnosis(log, placed.recording, placed.rows, None)
    if robot is None or recording is None:
        return None
    if placed.instrument.dimension == 1:
        reported = bool(others) or max(placed.instrument.tool.sigma[:3]) <= KNOWN
        recording = replace(recording, hidden=() if reported else (WIRE_SCALE.name,))
    free, at = robot.names, robot.model
    if others:
        try:
            beside = identify_instruments(model, log, others, options)
        except RobcalError:
            return _Case(at, recording, free, tuple(robot.eliminated))
        known = next(p.robot for p in beside.placed.values() if p.robot is not None)
        columns = [k for k, n in enumerate(known.names) if n not in kernel_ends()]
        names = [known.names[k] for k in columns]
        values = {n: known.model.parameters.get(n, 0.0) for n in (*names, *known.model.parameters)}
        at = at.with_parameters({**values, **{n: robot.model.parameters.get(n, 0.0) for n in free if n not in values}})
        free = tuple(n for n in free if n not in names)
        common = _known_errors(at, recording, names, known.covariance[np.ix_(columns, columns)])
        recording = replace(recording, common=common)
    return _Case(at, recording, free, tuple(robot.eliminated))


def _lengths_are_believed(options: IdentifyOptions | None) -> bool:
    """Whether lengths of the robot have priors, so that a wrong scale of a wire shows in them."""
    return any(n.rpartition(".")[2] in ("x", "y", "z") for n in (options.priors if options else {}))


def _scale_of(
    name: str,
    case: _Case,
    model: RobotModel,
    found: IdentifiedInstruments,
    log: JointLog,
    options: IdentifyOptions | None,
    reported: Sequence[ReportedCause],
) -> ReportedCause | None:
    """A wrong scale of a wire that leaves no trace in the residuals, where lengths of links with priors tell it."""
    known = any(t.instrument == name and t.finding.cause.stage == "wire" for t in reported)
    if known or options is None or not _lengths_are_believed(options):
        return None
    finding = scale_by_lengths(model, found, name, case.recording, log, options)
    return None if finding is None else ReportedCause(finding, name, by_priors=True)


def _known_errors(model: RobotModel, recording: Recording, names: Sequence[str], covariance: Array) -> Array:
    """Displacements (m, d, k) of measurements by one standard deviation of what is uncertain of a known robot."""
    kernel = kernel_of(model, "converged")
    inputs = recording.inputs(kernel)
    columns = np.array([kernel.index[n] for n in names], dtype=np.intp)
    frames, J = kernel.frames_and_jacobian(kernel.theta0, inputs, columns=columns)
    _, B = recording.observations.evaluate(frames)
    size = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    keep = values > 1e-10 * values.max()
    root = size[:, None] * vectors[:, keep] * np.sqrt(values[keep])
    return np.asarray(B @ J[recording.observations.pose] @ root)


def _compared(reported: ReportedCause, cases: Mapping[str, _Case]) -> ReportedCause:
    """A cause of the robot with what the other instruments say of it."""
    finding = reported.finding
    if isinstance(finding.cause, ObservationCause) or not len(finding.values):
        return reported
    agreeing, contradicting = [], []
    for name, case in cases.items():
        if name == reported.instrument:
            continue
        answer = _amplitudes(finding, case)
        if answer is None:
            continue
        values, covariance = answer
        seen = _improbable(finding.values, covariance)
        apart = _improbable(values - finding.values, covariance + finding.covariance)
        if seen < SHOWS and apart < CONTRADICTS:
            contradicting.append(name)
        elif _improbable(values, covariance) < SHOWS:
            agreeing.append(name)
    return replace(reported, agreeing=tuple(agreeing), contradicting=tuple(contradicting))


def _amplitudes(finding: Finding, case: _Case) -> tuple[Array, Array] | None:
    """Amplitudes of a cause, and their covariance, as another instrument sees them; None where it sees nothing."""
    start = Accepted(finding.cause, finding.constants, 0.0 * finding.values, finding.covariance)
    weighted = estimate_noise(case.model, case.recording, case.free).apply(case.recording)
    try:
        fitted = fit(case.model, weighted, case.free, [start])
    except (RobcalError, np.linalg.LinAlgError):
        return None
    item = fitted.accepted[0]
    if not np.all(np.diag(item.covariance) > 0):
        return None
    return item.values, item.covariance * fitted.variance_factor


def _improbable(values: Array, covariance: Array) -> float:
    """Probability of amplitudes as large as these by chance."""
    square = float(values @ np.linalg.pinv(covariance) @ values)
    return float(stats.chi2.sf(square, len(values)))


def _distinct(reported: Sequence[ReportedCause]) -> list[ReportedCause]:
    """Every cause of the robot once, by the instrument that shows it best; most significant first."""
    out: list[ReportedCause] = []
    for t in sorted(reported, key=lambda t: (t.finding.p_value, -t.finding.log_evidence)):
        same = [o for o in out if not o.of_instrument and o.finding.cause.key == t.finding.cause.key]
        if t.of_instrument or not same:
            out.append(t)
    return out

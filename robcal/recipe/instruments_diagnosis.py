"""Several instruments diagnosed: each by itself and against the others, and what they say of the robot together.

The instruments of the highest dimension are diagnosed with the robot as their own measurements tell it. Every other one
is judged against the robot that those identify, whose uncertainty counts as errors that all its measurements share. A
cause in a robot that one instrument shows and another contradicts belongs to the first instrument. Then the robot is
identified anew from all instruments, causes of the robot and parameters of wires together with it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import stats

from robcal.calibration.identification import IdentifyOptions
from robcal.calibration.instruments import IdentifiedInstruments, Instrument, PlacedInstrument, identify_instruments
from robcal.calibration.instruments.evaluator import kernel_ends
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import Rows
from robcal.calibration.wire import LIMITS
from robcal.diagnosis.core.fitting import Accepted, fit, terms_of
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.core.result import Diagnosis, Finding
from robcal.diagnosis.diagnose import diagnose
from robcal.diagnosis.noise.components import estimate_noise
from robcal.diagnosis.search.selection import SelectionSettings
from robcal.errors import RobcalError
from robcal.physics.cause import ObservationCause
from robcal.physics.measuring import WIRE_SCALE
from robcal.recipe.recording import recording_for_diagnosis
from robcal.recipe.robot_diagnosis import corrected
from robcal.recipe.wires import Correction, identify_with_corrections
from robcal.robot.kernel_cache import kernel_of
from robcal.robot.model import RobotModel
from robcal.transforms import Array

CONTRADICTS = 1e-3
"""Probability of two instruments' amplitudes below which they contradict each other."""
SHOWS = 1e-3
"""Probability of no effect below which an instrument shows a cause, or would show it if it were there."""
CERTAIN = 4.0
"""Standard deviations by which a wire's parameter must differ from nothing once all are identified together."""
KNOWN = 1e-4
"""m; a tool whose place is known to this carries the scale of a wire, and so do lengths of links with priors."""


@dataclass(frozen=True)
class Told:
    """A cause, which instrument shows it, which others do, and which contradict it.

    ``of_instrument`` : it belongs to the instrument, not to the robot.
    """

    finding: Finding
    instrument: str
    agreeing: tuple[str, ...] = ()
    contradicting: tuple[str, ...] = ()

    @property
    def of_instrument(self) -> bool:
        """Whether it belongs to the instrument that shows it."""
        return isinstance(self.finding.cause, ObservationCause) or bool(self.contradicting)

    @property
    def statement(self) -> str:
        """In a sentence."""
        if self.contradicting:
            others = " and ".join(f"'{name}'" for name in self.contradicting)
            return (
                f"instrument '{self.instrument}' shows what {others} contradicts, so it belongs to that instrument: "
                f"{self.finding.statement}"
            )
        if self.of_instrument:
            return f"instrument '{self.instrument}': {self.finding.statement}"
        return self.finding.statement


@dataclass(frozen=True)
class InstrumentsDiagnosis:
    """What a diagnosis of several instruments leaves behind.

    Attributes
    ----------
    own : the diagnosis of each instrument that was identified from. told : all causes, most significant first.
    found : the robot and all instruments identified anew beside them; the same object where nothing was found.
    start : the model with the causes of the robot, from which it was identified. not_told : what cannot be told.
    """

    own: Mapping[str, Diagnosis]
    told: tuple[Told, ...]
    found: IdentifiedInstruments = field(repr=False)
    start: RobotModel = field(repr=False)
    not_told: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


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
    not_told: list[str] = []
    cases: dict[str, _Case] = {}
    for name, placed in taking_part.items():
        against = others if placed.instrument.dimension < best else []
        case = _case(model, placed, log, against, options)
        if case is None:
            continue
        if case.recording.hidden:
            not_told.append(
                f"a wrong scale of wire '{name}' cannot be told: neither is its tool's place known nor do lengths of "
                "the robot have priors, and no instrument that measures more identifies the robot"
            )
        tell(f"instrument '{name}'")
        cases[name] = case
        own[name] = diagnose(case.model, case.recording, case.free, case.tied, None, settings or SelectionSettings())
    told = [Told(f, name) for name, d in own.items() for f in d.findings]
    told = _distinct([_compared(t, cases) for t in told])
    again, start = found, model
    notes: list[str] = []
    if told:
        again, start, notes = _identified_anew(model, found, instruments, log, options, corrections or {}, told, own)
        needless = [t for t in told if _is_needless(t, again)]
        if needless:  # the law of a search is linear: what it needed beside the right cause the exact one does not
            told = [t for t in told if t not in needless]
            again, start, notes = _identified_anew(
                model, found, instruments, log, options, corrections or {}, told, own
            )
    return InstrumentsDiagnosis(own, tuple(told), again, start, tuple(not_told), tuple(notes))


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
        told = bool(others) or _scale_is_carried(placed.instrument, options)
        recording = replace(recording, hidden=() if told else (WIRE_SCALE.name,))
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


def _scale_is_carried(wire: Instrument, options: IdentifyOptions | None) -> bool:
    """Whether anything has a known length, so that a wrong scale of the wire shows."""
    lengths = [n for n in (options.priors if options else {}) if n.rpartition(".")[2] in ("x", "y", "z")]
    return bool(lengths) or max(wire.tool.sigma[:3]) <= KNOWN


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


def _compared(told: Told, cases: Mapping[str, _Case]) -> Told:
    """A cause of the robot with what the other instruments say of it."""
    finding = told.finding
    if isinstance(finding.cause, ObservationCause) or not len(finding.values):
        return told
    agreeing, contradicting = [], []
    for name, case in cases.items():
        if name == told.instrument:
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
    return replace(told, agreeing=tuple(agreeing), contradicting=tuple(contradicting))


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


def _distinct(told: Sequence[Told]) -> list[Told]:
    """Every cause of the robot once, by the instrument that shows it best; most significant first."""
    out: list[Told] = []
    for t in sorted(told, key=lambda t: (t.finding.p_value, -t.finding.log_evidence)):
        same = [o for o in out if not o.of_instrument and o.finding.cause.key == t.finding.cause.key]
        if t.of_instrument or not same:
            out.append(t)
    return out


def _identified_anew(
    model: RobotModel,
    found: IdentifiedInstruments,
    instruments: Sequence[Instrument],
    log: JointLog,
    options: IdentifyOptions | None,
    corrections: Mapping[str, Correction],
    told: Sequence[Told],
    own: Mapping[str, Diagnosis],
) -> tuple[IdentifiedInstruments, RobotModel, list[str]]:
    """All instruments together once more: the robot's causes as terms, wires' as parameters, others taken back."""
    options, start = options or IdentifyOptions(), model
    of_robot = [t.finding for t in told if not t.of_instrument]
    for number, f in enumerate(of_robot):
        item = Accepted(f.cause, f.constants, f.values, f.covariance)
        if f.cause.free_parameters:
            if not isinstance(options.parameters, str):
                options = replace(options, parameters=(*options.parameters, *f.cause.free_parameters))
            continue
        start = start.with_terms(terms_of(item, number))
    freed = [_beside(i, [t.finding for t in told if t.instrument == i.name], own.get(i.name), log) for i in instruments]
    again = identify_with_corrections(start, log, freed, corrections, options)
    notes = []
    for name, placed in again.placed.items():
        before = found.placed[name]
        back = _returned(before, placed)
        if len(back):
            notes.append(
                f"instrument '{name}': {len(back)} poses that contradicted all others before are used again: "
                f"{', '.join(log.names[int(k)] for k in back[:5])}{', ...' if len(back) > 5 else ''}"
            )
    return again, start, notes


def _beside(instrument: Instrument, findings: Sequence[Finding], own: Diagnosis | None, log: JointLog) -> Instrument:
    """An instrument with parameters of its wire to be identified, or its measurements freed of what was found."""
    wires = tuple(kind for f in findings if (kind := _wire_parameter(f)))
    if wires:
        return replace(instrument, wire=tuple(dict.fromkeys((*instrument.wire, *wires))))
    clean = None if own is None else corrected(instrument.recording, log, own)
    return instrument if clean is None else replace(instrument, recording=clean)


def _is_needless(told: Told, found: IdentifiedInstruments) -> bool:
    """Whether a wire's parameter is not certain once it is identified beside all others."""
    kind = _wire_parameter(told.finding)
    value, sigma = found.placed[told.instrument].wire.get(kind, (0.0, 0.0)) if kind else (1.0, 0.0)
    return (bool(kind) and abs(value) < CERTAIN * sigma) or (bool(kind) and sigma == 0.0)


def _wire_parameter(finding: Finding) -> str:
    """The parameter of a wire that a cause stands for; empty for any other cause."""
    cause = finding.cause
    if isinstance(cause, ObservationCause) and cause.stage == "wire" and cause.parameters[0] in LIMITS:
        return cause.parameters[0]
    return ""


def _returned(before: PlacedInstrument, after: PlacedInstrument) -> Rows:
    """Rows that were left out before and are used now."""
    return np.intersect1d(before.rows[~before.used], after.rows[after.used])

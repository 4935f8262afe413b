"""Causes that several instruments show, and the robot that is identified anew beside those of them that pay."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from robcal.calibration.identification import IdentifyOptions
from robcal.calibration.instruments import IdentifiedInstruments, Instrument, PlacedInstrument
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import Rows
from robcal.calibration.wire import LIMITS
from robcal.diagnosis.core.fitting import Accepted, terms_of
from robcal.diagnosis.core.result import Diagnosis, Finding
from robcal.physics.cause import ObservationCause
from robcal.recipe.in_force import InForce
from robcal.recipe.instruments_in_force import InstrumentFolds, choose_among, contradicted_groups
from robcal.recipe.robot_diagnosis import corrected
from robcal.recipe.wires import Correction, identify_with_corrections
from robcal.robot.model import RobotModel

CERTAIN = 4.0
"""Standard deviations by which a wire's parameter must differ from nothing once all are identified together."""
NOT_CONFIRMED = "not confirmed on blocked folds, where poses are predicted no better with it"


@dataclass(frozen=True)
class ReportedCause:
    """A cause, which instrument shows it, which others do, and which contradict it.

    ``of_instrument`` : it belongs to the instrument, not to the robot. by_priors : what is believed of the robot's
    lengths tells it, no residual does.
    """

    finding: Finding
    instrument: str
    agreeing: tuple[str, ...] = ()
    contradicting: tuple[str, ...] = ()
    by_priors: bool = False

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
                f"{self.finding.full_statement}"
            )
        if self.of_instrument:
            why = "; else links would be off by more than they are believed to be" if self.by_priors else ""
            return f"instrument '{self.instrument}': {self.finding.full_statement}{why}"
        return self.finding.full_statement


@dataclass(frozen=True)
class InstrumentsDiagnosis:
    """What a diagnosis of several instruments leaves behind.

    Attributes
    ----------
    own : the diagnosis of each instrument that was identified from. reported : all causes, most significant first.
    found : the robot and all instruments identified anew beside those in force; the same object where none is.
    start : the model with the causes of the robot, from which it was identified.
    not_separable : what the measurements cannot separate.
    decided : which of the robot's terms pay over blocked folds, and why; None where nothing was found.
    """

    own: Mapping[str, Diagnosis]
    reported: tuple[ReportedCause, ...]
    found: IdentifiedInstruments = field(repr=False)
    start: RobotModel = field(repr=False)
    not_separable: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    decided: InForce | None = None

    @property
    def in_force(self) -> bool:
        """Whether anything that was found is in the robot that is delivered, or taken back from an instrument."""
        return any(not t.finding.waits for t in self.reported)


@dataclass(frozen=True)
class Anew:
    """What an identification beside causes needs; ``found`` : the one before, ``own`` : diagnosis of each."""

    model: RobotModel
    found: IdentifiedInstruments
    instruments: Sequence[Instrument]
    log: JointLog
    options: IdentifyOptions
    corrections: Mapping[str, Correction]
    own: Mapping[str, Diagnosis]

    def identified(
        self, reported: Sequence[ReportedCause]
    ) -> tuple[IdentifiedInstruments, RobotModel, IdentifyOptions]:
        """All instruments together once more: the robot's causes as terms, wires' as parameters, others taken back."""
        options, start = self.options, self.model
        for number, f in enumerate(_of_robot(reported)):
            if f.cause.free_parameters:
                if not isinstance(options.parameters, str):
                    options = replace(options, parameters=(*options.parameters, *f.cause.free_parameters))
                continue
            start = start.with_terms(terms_of(Accepted(f.cause, f.constants, f.values, f.covariance), number))
        freed = [
            _beside(i, [t.finding for t in reported if t.instrument == i.name], self.own.get(i.name), self.log)
            for i in self.instruments
        ]
        return identify_with_corrections(start, self.log, freed, self.corrections, options), start, options

    def notes(self, again: IdentifiedInstruments) -> list[str]:
        """Poses that are used again."""
        notes = []
        for name, placed in again.placed.items():
            back = _returned(self.found.placed[name], placed)
            if len(back):
                notes.append(
                    f"instrument '{name}': {len(back)} poses that contradicted all others before are used again: "
                    f"{', '.join(self.log.names[int(k)] for k in back[:5])}{', ...' if len(back) > 5 else ''}"
                )
        return notes


def _of_robot(reported: Sequence[ReportedCause]) -> list[Finding]:
    return [t.finding for t in reported if not t.of_instrument]


def delivered(anew: Anew, reported: Sequence[ReportedCause], not_separable: tuple[str, ...]) -> InstrumentsDiagnosis:
    """The robot with what pays over blocked folds; causes that these contradict become remarks."""
    reported, notes = list(reported), []
    while reported:
        again, start, options = anew.identified(reported)
        # the law of a search is linear: what it needed beside the right cause the exact one does not
        needless = [t for t in reported if _is_needless(t, again)]
        if not needless:
            folds = InstrumentFolds(start, again, anew.log, options)
            groups = _groups(reported, again)
            weak = contradicted_groups(
                folds, {k: names for k, names in groups.items() if names and not reported[int(k)].by_priors}
            )
            needless = [reported[int(k)] for k in weak]
            notes += [f"{NOT_CONFIRMED}: {t.statement}" for t in needless]
        if needless:
            reported = [t for t in reported if t not in needless]
            continue
        added = [n for k, names in groups.items() if not reported[int(k)].of_instrument for n in names]
        decided = choose_among(folds, added)
        reported = [_waiting(t, groups[str(k)], decided.waits) for k, t in enumerate(reported)]
        stay = [t for t in reported if not t.finding.waits]
        if len(stay) < len(reported):
            again, start, _ = anew.identified(stay) if stay else (anew.found, anew.model, options)
        notes = [*anew.notes(again), *notes]
        return InstrumentsDiagnosis(anew.own, tuple(reported), again, start, not_separable, tuple(notes), decided)
    return InstrumentsDiagnosis(anew.own, (), anew.found, anew.model, not_separable, tuple(notes))


def _groups(reported: Sequence[ReportedCause], found: IdentifiedInstruments) -> dict[str, tuple[str, ...]]:
    """Parameters by the number of each cause that it brought into the identification; none where it was taken back."""
    out: dict[str, tuple[str, ...]] = {}
    number = 0
    for k, t in enumerate(reported):
        f = t.finding
        names: tuple[str, ...] = ()
        if not t.of_instrument:
            names = Accepted(f.cause, f.constants, f.values, f.covariance).full_names(number)
            number += 1
        elif kind := _wire_parameter(f):
            names = (f"{t.instrument}.wire.{kind}",)
        out[str(k)] = tuple(n for n in names if n in found.names)
    return out


def _waiting(reported: ReportedCause, names: Sequence[str], waits: Mapping[str, str]) -> ReportedCause:
    why = next((waits[n] for n in names if n in waits), "")
    return replace(reported, finding=replace(reported.finding, waits=why)) if why else reported


def _beside(instrument: Instrument, findings: Sequence[Finding], own: Diagnosis | None, log: JointLog) -> Instrument:
    """An instrument with parameters of its wire to be identified, or its measurements freed of what was found."""
    wires = tuple(kind for f in findings if (kind := _wire_parameter(f)))
    if wires:
        return replace(instrument, wire=tuple(dict.fromkeys((*instrument.wire, *wires))))
    clean = None if own is None else corrected(instrument.recording, log, own)
    return instrument if clean is None else replace(instrument, recording=clean)


def _is_needless(reported: ReportedCause, found: IdentifiedInstruments) -> bool:
    """Whether a wire's parameter is not certain once it is identified beside all others."""
    kind = _wire_parameter(reported.finding)
    value, sigma = found.placed[reported.instrument].wire.get(kind, (0.0, 0.0)) if kind else (1.0, 0.0)
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

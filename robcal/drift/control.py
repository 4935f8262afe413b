"""Drift control as a pure function: a state, a reading, the next state and what happened.

Readings come singly, in parts of a tour spread over cycles of production. When every measurement of the tour is there,
the parameters are identified, tested, and, if nothing speaks against it, put in force. Nothing is stored here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robcal.drift.fit import DriftFit, Linearised, fit_drift
from robcal.drift.jumps import find_jump
from robcal.drift.reference import DriftReference, Readings, joined
from robcal.transforms import Array

AlarmKind = Literal["jump", "target", "bound", "stale", "clock"]
Use = Literal["open", "used", "rejected", "replaced", "expired", "late", "held"]
"""open: part of a tour that is not complete; used: identified a model; rejected: contradicts the others of its tour;
replaced: measured again in the same tour; expired: from before a standstill; late: older than the last tour; held: of
a tour that was not trusted."""

SLOW = 0.1
"""Share by which one tour changes the noise that is expected of the next."""


LEAST_NOISE = 0.2
"""Readings are not taken for better than this share of their stated variance."""
HELD_SHARE = 0.1
"""While a jump is on, so much of the thermal change is allowed for."""


@dataclass(frozen=True)
class Alarm:
    """What needs a person's attention."""

    cycle: int
    kind: AlarmKind
    text: str


@dataclass(frozen=True)
class Model:
    """Parameters in force from a cycle on.

    Attributes
    ----------
    change : (p,) m and rad since the reference; covariance : (p, p).
    time : s, of the tour that it was identified from.
    """

    cycle: int
    time: float
    change: Array
    covariance: Array


@dataclass(frozen=True)
class Tour:
    """An evaluated tour.

    Attributes
    ----------
    rows : of the readings that it consists of, in the order in which they were given; fit : what it says.
    accepted : whether its model was put in force.
    uncorrected, corrected, residual : m; mean displacement of the targets with the robot of the reference, with the
        model in force while they were measured, and with the new one.
    """

    cycle: int
    time: float
    rows: tuple[int, ...]
    fit: DriftFit
    accepted: bool
    uncorrected: float
    corrected: float
    residual: float


@dataclass(frozen=True)
class ControlState:
    """What the control remembers from one reading to the next.

    Attributes
    ----------
    model : in force; with the clock of its tour. noise : factor of the readings' variance that the last tours showed.
    newest_cycle, newest_time : of the readings so far. closed_cycle : of the last complete tour.
    held : a jump was found, nothing is put in force until the control is released, or the jump is gone.
    released : a person has released it: the next tour is not searched for jumps.
    bad_targets : those that the last tour contradicted.
    stale : the alarm for this age was given.
    paused : s, length of a standstill since the last complete tour, 0 if none.
    running : s, time of operation since the last complete tour.
    """

    model: Model
    noise: float = 1.0
    newest_cycle: int = -(2**62)
    newest_time: float = -np.inf
    closed_cycle: int = -(2**62)
    held: bool = False
    released: bool = False
    bad_targets: tuple[int, ...] = ()
    at_bound: tuple[str, ...] = ()
    stale: bool = False
    paused: float = 0.0
    running: float = 0.0


@dataclass(frozen=True)
class Events:
    """What readings brought about; ``uses`` says of each row, by its number, what became of it."""

    tours: tuple[Tour, ...] = ()
    alarms: tuple[Alarm, ...] = ()
    uses: dict[int, Use] = field(default_factory=dict)


@dataclass(frozen=True)
class _Open:
    """A reading of the tour that is not complete: a row of what was taken in together."""

    number: int
    source: Readings
    row: int

    @property
    def cycle(self) -> int:
        return int(self.source.cycle[self.row])


def _runs(rows: Sequence[_Open]) -> list[tuple[Readings, tuple[int, ...]]]:
    """Neighbours that came in together."""
    groups = groupby(rows, key=lambda row: id(row.source))
    return [(members[0].source, tuple(m.row for m in members)) for members in (list(g) for _, g in groups)]


class DriftControl:
    """Takes readings in one after the other.

    Parameters
    ----------
    state : where to go on. open_rows : readings of the tour that is not complete yet, with their numbers.
    """

    def __init__(
        self, reference: DriftReference, state: ControlState, open_rows: Sequence[tuple[int, Readings]] = ()
    ) -> None:
        self.reference = reference
        self.state = state
        self._open: dict[int, _Open] = {}
        for number, reading in open_rows:
            self._open[int(reference.slots(reading)[0])] = _Open(number, reading, 0)
        self._tours: list[Tour] = []
        self._alarms: list[Alarm] = []
        self._uses: dict[int, Use] = {}

    @property
    def missing(self) -> list[str]:
        """Measurements that the tour still lacks, as pose/target."""
        keys = zip(self.reference.poses, self.reference.targets.tolist(), strict=True)
        return [f"{pose}/{target}" for k, (pose, target) in enumerate(keys) if k not in self._open]

    def take(self, readings: Readings, numbers: Sequence[int]) -> Events:
        """Take readings in, in the order of their cycles; ``numbers`` name the rows in what is returned.

        Every reading must be one of the reference's measurements.
        """
        slots = self.reference.slots(readings)
        self._tours, self._alarms, self._uses = [], [], {}
        for i in np.argsort(readings.cycle, kind="stable"):
            self._take_one(int(slots[i]), _Open(int(numbers[i]), readings, int(i)))
        return Events(tuple(self._tours), tuple(self._alarms), dict(self._uses))

    def _take_one(self, slot: int, reading: _Open) -> None:
        number, cycle, time = reading.number, reading.cycle, float(reading.source.time[reading.row])
        if cycle < self.state.closed_cycle:
            if time > self.state.newest_time:
                self._alarm(cycle, "clock", f"cycle {cycle} comes after cycle {self.state.newest_cycle}: number on")
            self._uses[number] = "late"
            return
        self._pass_time(cycle, time)
        former = self._open.get(slot)
        if former is not None:
            older = former.cycle > cycle
            self._uses[number if older else former.number] = "replaced"
            if older:
                return
        self._open[slot] = reading
        self._uses[number] = "open"
        if len(self._open) == len(self.reference.poses):
            self._close()
        else:
            self._watch_age(cycle)

    def _pass_time(self, cycle: int, time: float) -> None:
        state, settings = self.state, self.reference.settings
        gap = time - state.newest_time
        if cycle > state.newest_cycle and gap < 0:
            self._alarm(
                cycle, "clock", f"the clock ran back by {-gap:.0f} s before cycle {cycle}: the tour begins anew"
            )
            self._expire()
            state = replace(state, newest_time=time, paused=max(state.paused, settings.standstill))
        elif gap > settings.standstill and np.isfinite(gap):
            self._expire()
            state = replace(state, paused=state.paused + gap)
        elif np.isfinite(gap):
            state = replace(state, running=state.running + max(gap, 0.0))
        self.state = replace(
            state, newest_cycle=max(cycle, state.newest_cycle), newest_time=max(time, state.newest_time)
        )

    def _expire(self) -> None:
        for reading in self._open.values():
            self._uses[reading.number] = "expired"
        self._open = {}

    def _watch_age(self, cycle: int) -> None:
        state, settings = self.state, self.reference.settings
        if state.stale or not (state.paused or state.running > settings.stale):
            return
        begun = min(reading.cycle for reading in self._open.values())
        if state.paused and cycle > begun:
            text = (
                f"after a standstill of {state.paused / 60:.0f} min the tour was not measured as a whole before "
                f"production went on: {self._lacking()}"
            )
        elif state.running > settings.stale:
            hours = state.running / 3600
            text = f"no tour was complete for {hours:.1f} h of operation: {self._lacking()}; the model is out of date"
        else:
            return
        self._alarm(cycle, "stale", text)
        self.state = replace(self.state, stale=True)

    def _lacking(self) -> str:
        lacking = self.missing
        return f"{len(lacking)} measurements are missing ({', '.join(lacking[:3])}{', ...' if lacking[3:] else ''})"

    def _close(self) -> None:
        order = sorted(self._open)
        rows = [self._open[slot] for slot in order]
        numbers = [row.number for row in rows]
        readings = joined([part.subset(list(at)) for part, at in _runs(rows)])
        self._open = {}
        slots = np.array(order, dtype=np.int64)
        state = self.state
        fit = fit_drift(self.reference, readings, slots, state.model.change, max(LEAST_NOISE, state.noise))
        cycle, time = int(readings.cycle.max()), float(readings.time.max())
        trouble = self._trouble(readings, slots, fit, time)
        accepted = trouble is None
        if trouble is not None and not state.held:
            self._alarm(cycle, "jump", trouble)
        kept = fit.kept
        for number, good in zip(numbers, kept, strict=True):
            self._uses[number] = ("used" if good else "rejected") if accepted else "held"
        means = [_mean(r[kept]) for r in (fit.uncorrected, fit.linear.r, fit.residual)]
        self._tours.append(Tour(cycle, time, tuple(numbers), fit, accepted, *means))
        self.state = replace(state, closed_cycle=cycle, stale=False, paused=0.0, running=0.0, held=not accepted)
        if accepted:
            self._accept(cycle, time, readings, slots, fit)

    def _trouble(self, readings: Readings, slots: NDArray[np.int64], fit: DriftFit, time: float) -> str | None:
        """Why a tour cannot be trusted, in words."""
        settings, state = self.reference.settings, self.state
        rows = np.flatnonzero(fit.kept)
        if len(rows) < (1 - settings.most_rejected) * len(fit.kept):
            return (
                f"{len(fit.kept) - len(rows)} of {len(fit.kept)} readings contradict the others: sensor and body are "
                "to be checked, the model stays as it was"
            )
        if state.released:
            return None
        elapsed = time - state.model.time
        if elapsed < 0:  # the clock was set back
            elapsed = settings.time_constant
        if state.held:  # time must not make a jump pass for drift
            elapsed = min(elapsed, HELD_SHARE * settings.time_constant)
        part = Linearised(fit.linear.r[rows], fit.linear.A[rows], fit.linear.C[rows])
        jump = find_jump(self.reference, slots[rows], part, elapsed, state.model.covariance)
        return None if jump is None else jump.text

    def _accept(self, cycle: int, time: float, readings: Readings, slots: NDArray[np.int64], fit: DriftFit) -> None:
        bad = tuple(sorted({int(t) for t, good in zip(readings.target, fit.kept, strict=True) if not good}))
        for target in sorted(set(bad) - set(self.state.bad_targets)):
            way = 1e3 * max(
                float(np.linalg.norm(r))
                for r, t, good in zip(fit.residual, readings.target, fit.kept, strict=True)
                if t == target and not good
            )
            self._alarm(
                cycle, "target", f"target {target} is off by {way:.2f} mm: dirty or shifted? Its readings were left out"
            )
        for name in sorted(set(fit.at_bound) - set(self.state.at_bound)):
            self._alarm(cycle, "bound", f"{name} would change beyond its bound and is held there")
        self.state = replace(
            self.state,
            model=Model(cycle, time, fit.change, fit.covariance),
            noise=(1 - SLOW) * self.state.noise + SLOW * min(fit.noise, 25.0),
            bad_targets=bad,
            at_bound=fit.at_bound,
        )

    def _alarm(self, cycle: int, kind: AlarmKind, text: str) -> None:
        self._alarms.append(Alarm(cycle, kind, text))


def started(reference: DriftReference, readings: Readings) -> ControlState:
    """The state right after the reference was taken."""
    p = len(reference.names)
    cycle, time = int(readings.cycle.max()), float(readings.time.max())
    return ControlState(
        Model(cycle, time, np.zeros(p), np.zeros((p, p))), newest_cycle=cycle, newest_time=time, closed_cycle=cycle
    )


def _mean(displacements: Array) -> float:
    return float(np.mean(np.linalg.norm(displacements, axis=1))) if len(displacements) else 0.0

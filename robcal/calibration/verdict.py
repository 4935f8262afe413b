"""The verdict on a calibrated robot: a table of rules over plain facts, each with its reason in words.

A grade says what a stranger with a second instrument may rely on: 'good' only where nothing speaks against it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from robcal.calibration.tolerance import FEW, Conformity

Grade = Literal["good", "care", "bad"]

LARGEST_SIGMA0 = 3.0
LARGEST_BEFORE_MM, LARGEST_BEFORE_DEG = 20.0, 2.0
"""What robots miss before their calibration, and are off their file, at most."""
LEAST_COVERAGE = 0.85
FEWEST_KEPT_OUT = 10
MODEST = 1.2
"""A robot whose errors shrink by less than this factor is not worth loading."""
MOST_NAMED = 3


@dataclass(frozen=True)
class Deviation:
    """A parameter of the robot, how far it is off the file, and in which unit ('mm', 'deg', 'kg')."""

    name: str
    value: float
    unit: str

    def __str__(self) -> str:
        return f"{self.name} {self.value:+.3g} {self.unit}"


@dataclass(frozen=True)
class Facts:
    """What the verdict rests on; None where it is not known.

    Attributes
    ----------
    sigma0 : root of the whitened sum of squares over redundancy. explained : the diagnosis accounts for it.
    before_mm, before_deg, after_mm : mean error of the nominal robot in its best cell and of the one in force.
    geometry : identified geometric deviations from the file.
    negative : elasticities and masses below zero by more than their uncertainty.
    mirrored : what is a mirror image, in words.
    untested : coordinates that contradict what was measured, or that nothing measured tests, in words.
    coverage_95 : share of the kept-out poses inside their 95 % region; kept_out : their number.
    disagreeing : results that contradict one another, in words.
    unexplained : the diagnosis finds structure that no cause explains; unnamed : part of the model has no name.
    elsewhere : kept-out poses were measured from another place or with another tool, in words.
    conformity : errors against the user's tolerance, None where there is none.
    """

    sigma0: float | None = None
    explained: bool = False
    before_mm: float | None = None
    before_deg: float | None = None
    after_mm: float | None = None
    geometry: Sequence[Deviation] = field(default=())
    negative: Sequence[Deviation] = field(default=())
    mirrored: Sequence[str] = field(default=())
    untested: Sequence[str] = field(default=())
    coverage_95: float | None = None
    kept_out: int = 0
    converged: bool = True
    disagreeing: Sequence[str] = field(default=())
    unexplained: bool = False
    unnamed: bool = False
    elsewhere: str = ""
    conformity: Conformity | None = None


@dataclass(frozen=True)
class Rule:
    """A grade that no verdict exceeds where ``reason`` finds one (empty: the rule is kept)."""

    name: str
    grade: Grade
    reason: Callable[[Facts], str]


@dataclass(frozen=True)
class Verdict:
    """Grade and the reasons that speak against 'good', worst first."""

    grade: Grade
    reasons: tuple[str, ...]

    @property
    def text(self) -> str:
        """One sentence."""
        word = {"good": "Good", "care": "Usable, with care", "bad": "Not to be used"}[self.grade]
        return f"{word}: {'; '.join(self.reasons)}." if self.reasons else f"{word}: nothing speaks against it."


def verdict(facts: Facts) -> Verdict:
    """The worst grade of all rules that are broken, and their reasons."""
    broken = [(rule.grade, reason) for rule in RULES if (reason := rule.reason(facts))]
    ordered = sorted(broken, key=lambda pair: _ORDER[pair[0]])
    return Verdict(ordered[0][0] if ordered else "good", tuple(reason for _, reason in ordered))


_ORDER: dict[Grade, int] = {"bad": 0, "care": 1, "good": 2}


def _named(deviations: Sequence[Deviation]) -> str:
    told = ", ".join(map(str, deviations[:MOST_NAMED]))
    return f"{told}{', ...' if len(deviations) > MOST_NAMED else ''}"


def _gain(f: Facts) -> str:
    if f.before_mm is None or not f.after_mm or f.before_mm >= MODEST * f.after_mm:
        return ""
    return "calibration does not make this robot better"


def _mirror(f: Facts) -> str:
    return f"{', '.join(f.mirrored)} mirrored" if f.mirrored else ""


def _convergence(f: Facts) -> str:
    return "" if f.converged or _tested(f) else "the identification did not converge"


def _unfinished(f: Facts) -> str:
    if f.converged or not _tested(f):
        return ""
    return "the identification did not converge, though its uncertainties hold at the kept-out poses"


def _tested(f: Facts) -> bool:
    """Whether kept-out poses show that the stated uncertainties hold, whatever the iterations did."""
    return f.coverage_95 is not None and f.coverage_95 >= LEAST_COVERAGE and f.kept_out >= FEWEST_KEPT_OUT


def _sigma0(f: Facts) -> str:
    if f.sigma0 is None or f.sigma0 <= LARGEST_SIGMA0 or f.explained:
        return ""
    return f"the measurements scatter {f.sigma0:.1f} times as much about the robot as they state, unexplained"


def _before(f: Facts) -> str:
    missed = []
    if f.before_mm is not None and f.before_mm > LARGEST_BEFORE_MM:
        missed.append(f"{f.before_mm:.3g} mm")
    if f.before_deg is not None and f.before_deg > LARGEST_BEFORE_DEG:
        missed.append(f"{f.before_deg:.3g} deg")
    return f"before calibration the robot missed by {' and '.join(missed)}, more than robots do" if missed else ""


def _geometry(f: Facts) -> str:
    limit = {"mm": LARGEST_BEFORE_MM, "deg": LARGEST_BEFORE_DEG}
    far = [d for d in f.geometry if abs(d.value) > limit[d.unit]]
    far.sort(key=lambda d: -abs(d.value) / limit[d.unit])
    return f"the robot file contradicts the recording: {_named(far)}" if far else ""


def _negative(f: Facts) -> str:
    return f"elasticities or masses below zero, which cannot be: {_named(f.negative)}" if f.negative else ""


def _untested(f: Facts) -> str:
    return "; ".join(f.untested)


def _coverage(f: Facts) -> str:
    if f.coverage_95 is None or not f.kept_out or f.coverage_95 >= LEAST_COVERAGE:
        return ""
    return (
        f"the errors are larger than their predicted uncertainty ({100 * f.coverage_95:.0f} % inside the 95 % region)"
    )


def _kept_out(f: Facts) -> str:
    if f.kept_out >= FEWEST_KEPT_OUT:
        return ""
    return f"tested on {f.kept_out} poses only" if f.kept_out else "tested on no pose"


def _missed(f: Facts) -> str:
    return f.conformity.statement if f.conformity is not None and _often(f.conformity) else ""


def _close(f: Facts) -> str:
    c = f.conformity
    return c.statement if c is not None and not _often(c) and (c.over or c.undecided) else ""


def _often(c: Conformity) -> bool:
    return c.beyond > FEW * c.places


RULES: tuple[Rule, ...] = (
    Rule("tolerance", "bad", _missed),
    Rule("elsewhere", "bad", lambda f: f.elsewhere),
    Rule("gain", "bad", _gain),
    Rule("mirrored", "bad", _mirror),
    Rule("agreement", "bad", lambda f: "; ".join(f.disagreeing)),
    Rule("convergence", "bad", _convergence),
    Rule("unfinished", "care", _unfinished),
    Rule("sigma0", "care", _sigma0),
    Rule("before", "care", _before),
    Rule("geometry", "care", _geometry),
    Rule("negative", "care", _negative),
    Rule("coordinates", "care", _untested),
    Rule("coverage", "care", _coverage),
    Rule("kept out", "care", _kept_out),
    Rule("tolerance in doubt", "care", _close),
    Rule("unexplained", "care", lambda f: "the diagnosis finds structure that it cannot explain" * f.unexplained),
    Rule("unnamed", "care", lambda f: "part of the correction is an empirical term without a name" * f.unnamed),
)

"""Which parameters to identify: order of preference, what is plausible, choice of elasticities by evidence, indices.

Geometry: all deviations are candidates; those that others can replace, or that the data determine worse than anybody
could guess them beforehand, are eliminated and named (:func:`robcal.estimation.dependence.split_dependent`).
Elasticities are taken up only where the data ask for them, by F-tests on the identification poses: a needless one costs
accuracy at other poses, a missing one too.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, special

from robcal.calibration.wire import LIMITS as WIRE_LIMITS
from robcal.errors import InvalidInput, NotIdentifiable
from robcal.robot.loops import FOUR_BAR_LENGTHS
from robcal.robot.model import GEOMETRIC_KINDS, LENGTH_KINDS, RobotModel, frame_kinds, geometric_kinds
from robcal.robot.statics import moment_names
from robcal.robot.terms import identifier

Array = NDArray[np.float64]

PLAUSIBLE_LENGTH = 2e-3
"""A length deviation (m) that the data determine worse than this is left at nominal."""
PLAUSIBLE_ANGLE = 2e-3
"""The same for angles (rad), and for what an elasticity turns its angle at the largest moment met."""

PLAUSIBLE_START = 0.1
"""Base and tool are not known beforehand; what the data leave open by more than this (m, rad) stays as constructed."""

SAME_POSE = 1e-4
"""Joint angles (rad) within which poses count as repetitions of one another."""

OWN_AXIS_LEVEL = 0.05
"""An elasticity about the joint's own axis stays unless its F-test gives a p-value above this: it is known to exist."""
CROSS_AXIS_LEVEL = 0.01
"""One across the axis enters only below this, divided by the number of candidates (Bonferroni)."""

CRANK_FIRST = ("crank_angle", *FOUR_BAR_LENGTHS)

TABLE_5_4 = (
    ("roll", "elastic_roll", "elastic_pitch"),
    ("roll", "elastic_pitch", "pitch", "yaw", "x"),
    ("roll", "elastic_roll", "elastic_pitch", "pitch", "yaw", "x"),
    ("elastic_roll", "elastic_pitch", "yaw", "x", "z"),
    ("elastic_pitch", "pitch", "yaw", "elastic_yaw", "y", "z"),
    ("elastic_roll", "elastic_pitch", "pitch", "elastic_yaw", "yaw"),
)
"""A set of 30 parameters by axis that has proved itself for an arm with axes z, y, y, x, y, x."""


@dataclass(frozen=True)
class Candidates:
    """Names in order of preference.

    Attributes
    ----------
    forced : kept whenever the data can tell them apart: base, tool, geometry, terms.
    own_axis, cross_axis : elasticities to be chosen by evidence; empty if the caller named the parameters.
    """

    forced: tuple[str, ...]
    own_axis: tuple[str, ...] = ()
    cross_axis: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """All of them, best first."""
        return (*self.forced, *self.own_axis, *self.cross_axis)


def choose_candidates(model: RobotModel, parameters: str | Sequence[str]) -> Candidates:
    """Candidates of a choice 'standard', 'geometry', 'table5.4', 'none' (the robot stays as it is), or of named ones.

    Base and tool are always among them. Order of preference within the geometry: base, tool, the joints' zero offsets,
    then frame by frame from the base; so what remains ambiguous is reported in terms of the outer frames.

    Raises
    ------
    InvalidInput : unknown choice or name, or Table 5.4 for another kind of arm.
    """
    ends = [f"{end}.{k}" for end in ("base", "tool") for k in GEOMETRIC_KINDS]
    zeros = [f.zero_name for f in model.joints]
    others = [f"{f.name}.{k}" for f in model.frames for k in geometric_kinds(f)]
    # of a four-bar only the ratios of its lengths show: the ground, which comes last, stays as constructed
    others += [f"{f.name}.{k}" for f in model.frames if f.fourbar is not None for k in CRANK_FIRST]
    others = [name for name in others if name not in zeros]
    terms = list(dict.fromkeys(n for t in model.terms for n in t.parameter_names))
    own = [f.elastic_name for f in model.joints if not f.prismatic]
    every = [f"{f.name}.{k}" for f in model.frames for k in frame_kinds(f) if k.startswith("elastic_")]
    cross = [name for name in every if name not in own]
    if parameters == "standard":
        return Candidates((*ends, *zeros, *others, *terms), tuple(own), tuple(cross))
    if parameters == "none":
        return Candidates(tuple(ends))
    if parameters == "geometry":
        return Candidates((*ends, *zeros, *others, *terms))
    if parameters == "table5.4":
        if [f.axis for f in model.joints] != ["z", "y", "y", "x", "y", "x"] or any(f.prismatic for f in model.joints):
            raise InvalidInput(
                "the set table5.4 is for arms with rotary axes z, y, y, x, y, x; choose standard for this robot"
            )
        table = [f"{f.name}.{k}" for f, kinds in zip(model.joints, TABLE_5_4, strict=True) for k in kinds]
        return Candidates((*ends, *table, *terms))
    if isinstance(parameters, str):
        raise InvalidInput(
            f"parameters must be standard, geometry, table5.4, none or a list of names, not '{parameters}'"
        )
    return Candidates(tuple(dict.fromkeys((*ends, *parameters, *terms))))


def plausible_limits(model: RobotModel, moments: Array, names: Sequence[str]) -> Array:
    """Standard deviation (p,) above which a parameter is not worth identifying; infinite for loads.

    Terms: twice the prior, infinite without one.

    ``moments`` are the poses' moments (n, m) in the order of :func:`robcal.robot.statics.moment_names`.
    """
    return limits_at(*limit_rules(model, names), moments)


def limit_rules(model: RobotModel, names: Sequence[str]) -> tuple[Array, NDArray[np.intp]]:
    """Limits (p,) that do not depend on the poses, and the column (p,) of the moment that the others depend on (-1)."""
    limits, columns = np.full(len(names), np.inf), np.full(len(names), -1, dtype=np.intp)
    moment = {name: k for k, name in enumerate(moment_names(model))}
    frames = {f.name: f for f in model.frames}
    priors = {f"{t.name}.{short}": 2.0 * sigma for t in model.terms for short, sigma in t.priors.items()}
    for k, name in enumerate(names):
        frame, _, kind = name.rpartition(".")
        end = frame.rpartition(".")[2]
        limits[k] = priors.get(name, PLAUSIBLE_START if end in ("base", "tool") else np.inf)
        if end == "wire":
            limits[k] = WIRE_LIMITS[kind]
        if frame not in frames:
            continue
        if kind in LENGTH_KINDS:
            limits[k] = PLAUSIBLE_LENGTH
        elif kind in ("roll", "pitch", "yaw", "crank_angle"):
            limits[k] = PLAUSIBLE_ANGLE
        else:
            about = frames[frame].joint_kind if kind == "elastic_crank" else kind.removeprefix("elastic_")
            columns[k] = moment[f"{identifier(frame)}_m{about}"]
    return limits, columns


def limits_at(limits: Array, columns: NDArray[np.intp], moments: Array) -> Array:
    """The rules of :func:`limit_rules` with the largest moments of the poses (n, m) put in."""
    elastic = columns >= 0
    out = limits.copy()
    if np.any(elastic):
        largest = np.abs(moments).max(axis=0, initial=0.0)
        out[elastic] = PLAUSIBLE_ANGLE / np.maximum(largest[columns[elastic]], 1e-9)
    return out


def weak_parameters(names: Sequence[str], covariance: Array, limits: Array) -> tuple[str, ...]:
    """Names that may go back to nominal, the weakest first, until the data determine all others within their limits.

    Parameters
    ----------
    names, covariance : (p,) fitted parameters and their covariance (p, p). limits : (p,) largest standard deviation.

    Each one that goes is taken as known, which determines those better that were tied to it.
    """
    left = np.array(covariance, dtype=float)
    gone: list[str] = []
    while True:
        excess = np.sqrt(np.clip(np.diag(left), 0.0, None)) / limits
        worst = int(np.argmax(excess))
        if not excess[worst] > 1.0:
            return tuple(gone)
        gone.append(names[worst])
        left -= np.outer(left[:, worst], left[worst]) / left[worst, worst]
        left[worst], left[:, worst] = 0.0, 0.0


@dataclass(frozen=True)
class StepwiseChoice:
    """Result of the choice by evidence.

    Attributes
    ----------
    taken : indices (into the optional columns) that stay.
    p_values : p-value of each optional column: of removing it if taken, of adding it if not.
    """

    taken: tuple[int, ...]
    p_values: Array


def choose_by_evidence(N: Array, b: Array, rest: float, rows: int, forced: int, n_own: int) -> StepwiseChoice:
    """Backward and forward choice among optional columns by F-tests.

    Parameters
    ----------
    N, b, rest : normal matrix (p, p), right side (p,) and sum of squares of a whitened linear problem whose columns are
        forced ones first, then own-axis elasticities, then cross-axis ones; the residuals are those for all optional
        parameters at zero.
    rows : number of residuals; forced : number of forced columns; n_own : of own-axis ones.

    Weakness: stepwise; of two columns that say nearly the same the one tested last stays.
    """
    optional = _Optional.of(N, b, rest, rows, forced)
    m, alive = len(optional.c), optional.alive
    n_cross = max(1, sum(1 for j in alive if j >= n_own))
    level = np.where(np.arange(m) < n_own, OWN_AXIS_LEVEL, CROSS_AXIS_LEVEL / n_cross)
    chosen = [k for k in alive if k < n_own]
    values = optional.p_values(chosen)
    for _ in range(4 * m + 4):
        urgency = values / level
        worst = max(((urgency[k], k) for k in chosen), default=(0.0, -1))
        if worst[0] > 1.0:
            chosen.remove(worst[1])
        else:
            best = min(((urgency[k], k) for k in alive if k not in chosen), default=(1.0, -1))
            if best[0] >= 0.5:  # stricter than for staying, so that nothing goes round in circles
                break
            chosen.append(best[1])
        values = optional.p_values(chosen)
    return StepwiseChoice(tuple(sorted(chosen)), values)


@dataclass(frozen=True)
class _Optional:
    """Normal equations E (m, m), c (m,) of the optional columns after the forced ones, what these leave of the sum of
    squares, and the degrees of freedom then."""

    E: Array
    c: Array
    rest: float
    freedom: int

    @classmethod
    def of(cls, N: Array, b: Array, rest: float, rows: int, forced: int) -> "_Optional":
        """Eliminate the forced columns."""
        scale = np.sqrt(np.where(np.diag(N) > 0, np.diag(N), 1.0))
        N, b = N / np.outer(scale, scale), b / scale
        f = slice(0, forced)
        solved = linalg.lstsq(N[f, f], np.column_stack([N[f, forced:], b[f]]), cond=1e-13)[0]
        E = N[forced:, forced:] - N[forced:, f] @ solved[:, :-1]
        c = b[forced:] - N[forced:, f] @ solved[:, -1]
        return cls(E, c, rest - float(b[f] @ solved[:, -1]), rows - forced)

    @property
    def alive(self) -> list[int]:
        """Columns that are no combination of the forced ones."""
        return np.flatnonzero(np.diag(self.E) > 1e-10).tolist()

    def p_values(self, chosen: Sequence[int]) -> Array:
        """p-values (m,): of removing each of the chosen, of adding each of the others; one for what is no candidate."""
        values = np.ones(len(self.c))
        others = [k for k in self.alive if k not in chosen]
        total = self.rest
        inverse: Array = np.zeros((0, 0))
        across: Array = self.E[np.ix_(chosen, others)]
        if chosen:
            inverse = np.asarray(np.linalg.inv(self.E[np.ix_(chosen, chosen)]), dtype=float)
            x = inverse @ self.c[chosen]
            total = self.rest - float(self.c[chosen] @ x)
            values[chosen] = self._p_value(x**2 / np.diag(inverse), total, len(chosen))
        if others:
            pivot = self.E[others, others] - np.einsum("ij,ij->j", across, inverse @ across)
            left = self.c[others] - across.T @ (inverse @ self.c[chosen])
            gain = np.where(pivot > 1e-12, left**2 / np.maximum(pivot, 1e-12), 0.0)
            values[others] = self._p_value(gain, total - gain, len(chosen) + 1)
        return values

    def _p_value(self, drop: Array, total: Array | float, n_chosen: int) -> Array:
        freedom = self.freedom - n_chosen
        if freedom <= 0:
            return np.ones(len(drop))
        positive = np.maximum(total, 1e-300)
        p = special.fdtrc(1, freedom, np.maximum(drop, 0.0) * freedom / positive)
        return np.where(np.asarray(total) > 0, p, 1.0)


def observability_indices(singular_values: Array) -> dict[str, float]:
    """O1 to O5 of the singular values (largest first) of the identification Jacobian.

    Source: Sun and Hollerbach (2008), "Observability index selection for robot calibration"; O1 after Borm and Menq,
    O2 Driels and Pathre, O3 and O4 Nahvi and Hollerbach, O5 Sun and Hollerbach. The values are per row: the caller
    divides by the root of the number of rows.
    """
    s = np.asarray(singular_values, dtype=float)
    if len(s) == 0 or s[-1] <= 0:
        return {"O1": 0.0, "O2": 0.0, "O3": 0.0, "O4": 0.0, "O5": 0.0}
    return {
        "O1": float(np.exp(np.mean(np.log(s)))),
        "O2": float(s[-1] / s[0]),
        "O3": float(s[-1]),
        "O4": float(s[-1] ** 2 / s[0]),
        "O5": float(1.0 / np.sum(1.0 / s)),
    }


def repetitions(q: ArrayLike, tolerance: float = SAME_POSE) -> NDArray[np.int64]:
    """Labels (n,) of poses; those whose joint angles agree within the tolerance (after rounding) share one."""
    rounded = np.round(np.asarray(q, dtype=float) / tolerance).astype(np.int64)
    if len(rounded) == 0:
        return np.zeros(0, dtype=np.int64)
    return np.unique(rounded, axis=0, return_inverse=True)[1].ravel()


def check_poses(q: Array, rows: int, parameters: Sequence[str]) -> None:
    """Refuse data that cannot determine the parameters.

    Raises
    ------
    NotIdentifiable : all poses alike, or no more measured numbers than parameters.
    """
    if len(q) == 0 or np.all(np.ptp(q, axis=0) < 1e-3):
        raise NotIdentifiable(
            f"all {len(q)} poses are alike: nothing about the joints can be identified, move every joint", parameters
        )
    if rows <= len(parameters):
        distinct = int(repetitions(q, 1e-3).max(initial=-1)) + 1
        raise NotIdentifiable(
            f"{len(q)} poses ({distinct} distinct) give {rows} measured numbers for {len(parameters)} or more "
            "parameters: measure more poses or choose fewer parameters (model: parameters)",
            parameters,
        )

"""Whether joints share one curve: patterns on trial, judged by how well kept-out poses are predicted."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from robcal.diagnosis.core.fitting import Accepted, Fit
from robcal.diagnosis.scan.tangents import Tangents
from robcal.diagnosis.search.folded_normals import amplitudes, folded
from robcal.diagnosis.search.shared_curve import maker, refined, seats
from robcal.physics.angle_error_curve import Placed, difference_from_shared
from robcal.physics.cause import Array, RobotCause
from robcal.physics.site import Joint

BUMPS_SHARED = 72
"""Bumps a turn of a curve that joints share: all of them together show its finest waves."""

OWN_SIZES = (0.3, 0.6, 0.1)
"""Sizes, in those of a curve, of what joints that share one may differ by; the kept-out poses choose."""

LEAST_JOINING = 20.0
"""Deviance of kept-out poses by which a shared curve must predict them better: twice the logarithm of the 480 turns and
senses that are tried, and as much as decisive evidence (Kass and Raftery, 1995)."""

LEAST_SHARED = 2
"""Joints that must have a curve in common."""


@dataclass(frozen=True)
class CurvesOnTrial:
    """Curves of joints on trial: where they are linearised, folds of the rows, causes and their scaled columns."""

    present: Fit
    at: Tangents
    label: Array
    causes: Sequence[RobotCause]
    columns: Sequence[Array]


def accepted_with(present: Fit, causes: Sequence[RobotCause], columns: Sequence[Array]) -> tuple[Accepted, ...]:
    """Causes with the amplitudes that fit, scaled columns (m, c) each."""
    values = amplitudes(present, columns)
    return tuple(
        Accepted(f, f.grid[0], v * f.sizes(f.grid[0]), np.zeros((len(v), len(v))))
        for f, v in zip(causes, values, strict=True)
    )


@dataclass(frozen=True)
class SharedOnTrial:
    """A pattern with its curve on trial: deviance of each kept-out fold, size of what joints differ by."""

    deviance: Array
    size: float
    placed: tuple[Placed, ...]
    cause: RobotCause
    columns: tuple[Array, ...]

    @property
    def total(self) -> float:
        """Deviance of all folds."""
        return float(self.deviance.sum())


def with_shared(
    group: CurvesOnTrial, placed: Sequence[Placed], joints: Sequence[Joint], count: int
) -> tuple[tuple[Accepted, ...], list[Array]] | None:
    """One curve for the joints of a pattern, and what each differs by, where that predicts kept-out poses better."""
    if len(placed) < LEAST_SHARED:
        return None
    make = maker(BUMPS_SHARED, group.at.variables, count)

    def solve(columns: Sequence[Array]) -> list[Array]:
        return amplitudes(group.present, columns)

    placed = refined(placed, make, group.at, solve, _own_columns(group, placed, OWN_SIZES[0]))
    found = min((_tried(group, placed, make, size) for size in OWN_SIZES), key=lambda t: t.total)
    found = _grown(group, found, joints, make, solve)
    trials = [found, *(_tried(group, found.placed, make, size) for size in OWN_SIZES[1:])]
    found = min(trials, key=lambda t: t.total)
    alone = folded(group.present, group.columns, group.label).deviance(range(len(group.columns)))
    if not _clear(alone, found.deviance):
        return None
    members = {p.joint.where for p in found.placed}
    causes = [difference_from_shared(f, found.size) if f.where in members else f for f in group.causes]
    return accepted_with(group.present, [found.cause, *causes], found.columns), list(found.columns)


def _clear(before: Array, after: Array) -> bool:
    """Whether deviances (folds,) fall beyond doubt, and in most folds."""
    return bool(np.sum(before - after) > LEAST_JOINING and 2 * np.sum(after < before) > len(before))


def _grown(
    group: CurvesOnTrial,
    found: SharedOnTrial,
    joints: Sequence[Joint],
    make: Callable[[Sequence[Placed]], RobotCause],
    solve: Callable[[Sequence[Array]], list[Array]],
) -> SharedOnTrial:
    """The pattern with the further joints in which the curve predicts kept-out poses clearly better than their own.

    Their own poses may show too little of their curve to tell that it is the same; with every joint that joins the
    curve is known better, so those that were left are tried again.
    """
    grew = True
    while grew:
        grew = False
        for joint in (j for j in joints if j.where not in {p.joint.where for p in found.placed}):
            others = [c for f, c in zip(group.causes, found.columns[1:], strict=True) if f.where != joint.where]
            tried = [
                _tried(group, (*found.placed, seat), make, found.size)
                for seat in seats(group.present, group.at, found.cause, joint, found.columns[0], others, amplitudes)
            ]
            best = min(tried, key=lambda t: t.total)
            if not _clear(found.deviance, best.deviance):
                continue
            turned = refined(best.placed, make, group.at, solve, _own_columns(group, best.placed, best.size))
            found = min(best, _tried(group, turned, make, best.size), key=lambda t: t.total)
            grew = True
    return found


def _own_columns(group: CurvesOnTrial, placed: Sequence[Placed], size: float) -> list[Array]:
    """Scaled columns of the joints' own curves, `size` times as large for those that share one."""
    members = {p.joint.where for p in placed}
    return [c * (size if f.where in members else 1.0) for f, c in zip(group.causes, group.columns, strict=True)]


def _tried(
    group: CurvesOnTrial, placed: tuple[Placed, ...], make: Callable[..., RobotCause], size: float
) -> SharedOnTrial:
    """A pattern beside curves of all joints, those of its members `size` times as large."""
    own, cause = _own_columns(group, placed, size), make(placed)
    common = group.at.columns(cause, cause.grid[0]) * cause.sizes(cause.grid[0])
    after = folded(group.present, [common, *own], group.label).deviance(range(len(own) + 1))
    return SharedOnTrial(after, size, placed, cause, (common, *own))

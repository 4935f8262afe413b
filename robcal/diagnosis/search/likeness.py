"""How curves of joints are shaped: joints whose curves are alike, and how irregular a curve is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robcal.diagnosis.core.fitting import Accepted
from robcal.physics.angle_error_curve import Placed
from robcal.physics.cause import Array, LinearCause
from robcal.physics.site import Joint

WAVES = 2

HIGHEST_WAVE = 60.0

LEAST_OVERLAP = np.deg2rad(120.0)

ALIKE = 0.75


@dataclass(frozen=True)
class Likeness:
    """A joint whose curve is that of another: `joint(q) = sense * other(sense * q + shift)`.

    Attributes
    ----------
    joint, other : a joint and an earlier one that has the same curve. shift : rad.
    sense : -1 for a part mounted the other way round.
    correlation : of the two curves where both are known. overlap : rad.
    """

    joint: str
    other: str
    sense: int
    shift: float
    correlation: float
    overlap: float


def curve(item: Accepted, angles: Array) -> Array:
    """Value (n,) of an accepted curve at angles (n,) of its joint, rad."""
    name = item.cause.covariates[0]
    bases = item.cause.laws(item.constants)
    return np.asarray(np.sum([v * b.value({name: angles}) for b, v in zip(bases, item.values, strict=True)], axis=0))


def irregularity(cause: LinearCause, values: Array, angles: Array) -> float:
    """Share of a curve's variance at the recorded angles that a few waves of any order leave."""
    left = curve(Accepted(cause, cause.grid[0], values, np.zeros((0, 0))), angles)
    left = left - np.mean(left)
    total = float(left @ left)
    if total == 0.0:
        return 0.0
    for _ in range(WAVES):
        trials = []
        for order in np.arange(0.25, HIGHEST_WAVE, 0.25):
            wave = np.column_stack([np.ones(len(angles)), np.cos(order * angles), np.sin(order * angles)])
            # normal equations: three columns, and a share of a variance needs no digits
            rest = left - wave @ np.linalg.solve(wave.T @ wave + 1e-9 * len(angles) * np.eye(3), wave.T @ left)
            trials.append((float(rest @ rest), order, rest))
        left = min(trials, key=lambda t: t[0])[2]
    return float(left @ left) / total


def likenesses(accepted: Sequence[Accepted], angles: Sequence[Array]) -> tuple[Likeness, ...]:
    """For each curve the earlier one that it resembles most, turned and maybe reversed; slow waves do not count.

    Parameters
    ----------
    angles : recorded angles of the joint of each curve, rad: a curve is compared only where it was measured.
    """
    steps = 720
    grid = 2.0 * np.pi * np.arange(steps) / steps
    curves, known = [], []
    for item, q in zip(accepted, angles, strict=True):
        seen = np.zeros(steps, dtype=bool)
        at = np.round((q % (2.0 * np.pi)) / (2.0 * np.pi) * steps).astype(int)
        for shift in range(-4, 5):
            seen[(at + shift) % steps] = True
        y = curve(item, grid)
        slow = np.column_stack([np.ones(steps), *(f(m * grid) for m in (1, 2) for f in (np.cos, np.sin))])
        y = y - slow @ np.linalg.lstsq(slow[seen], y[seen], rcond=1e-6)[0]
        curves.append(y)
        known.append(seen)
    found = []
    for j in range(1, len(curves)):
        best: Likeness | None = None
        for i in range(j):
            for sense in (1, -1):
                # curve j at q against sense * curve i at sense * q + shift
                index = (sense * np.arange(steps)) % steps
                for shift in range(steps):
                    there = (index + shift) % steps
                    both = known[j] & known[i][there]
                    overlap = float(both.sum()) * 2.0 * np.pi / steps
                    if overlap < LEAST_OVERLAP:
                        continue
                    a, b = curves[j][both], sense * curves[i][there][both]
                    r = float(a @ b) / max(float(np.sqrt((a @ a) * (b @ b))), 1e-300)
                    if r > ALIKE and (best is None or r > best.correlation):
                        best = Likeness(
                            accepted[j].cause.where,
                            accepted[i].cause.where,
                            sense,
                            shift * 2.0 * np.pi / steps,
                            r,
                            overlap,
                        )
        if best is not None:
            found.append(best)
    return tuple(found)


def pattern(joints: Sequence[Joint], likenesses: Sequence[Likeness]) -> tuple[Placed, ...]:
    """The largest group of joints (in their order) whose curves are alike, the first of them as reference."""
    groups: list[dict[str, Placed]] = []
    by_name = {joint.where: joint for joint in joints}
    for like in likenesses:
        group = next((g for g in groups if like.other in g), None)
        if group is None:
            group = {like.other: Placed(by_name[like.other])}
            groups.append(group)
        other = group[like.other]
        # sense (other.sense c(other.sense (sense q + shift) + other.shift))
        shift = float((other.sense * like.shift + other.shift) % (2.0 * np.pi))
        group[like.joint] = Placed(by_name[like.joint], like.sense * other.sense, shift)
    return tuple(max(groups, key=len).values()) if groups else ()

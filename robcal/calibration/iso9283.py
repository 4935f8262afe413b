"""Pose and distance characteristics of ISO 9283:1998 from repeated poses: RP, vAP, AD, RD and drift.

Poses are the groups of repetitions of the same joint angles; a cycle is one visit of them. The commanded pose is what
the model predicts. The standard asks for 30 cycles (ten for each look at drift); from fewer the figures are given, and
said to be of fewer.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.transforms import Array

CYCLES = 30
"""Cycles that the standard asks for."""
LOOK = 10
"""Cycles of one look at the drift."""


@dataclass(frozen=True)
class Characteristics:
    """Terms of ISO 9283, m; NaN where the recording does not tell.

    Attributes
    ----------
    poses : poses that were repeated; cycles : fewest visits of one of them.
    ap, rp : largest pose accuracy and repeatability of position (RP = mean distance from the barycentre + 3 S).
    vap : largest distance between barycentres of one pose reached from different directions; directions : how many.
    ad, rd : distance accuracy (signed, of the largest size) and repeatability (3 S) between the two poses farthest
        apart; distance : between them as commanded.
    dap, drp : largest change of AP and RP against the first look; looks : how many.
    """

    poses: int
    cycles: int
    ap: float
    rp: float
    vap: float
    directions: int
    ad: float
    rd: float
    distance: float
    dap: float
    drp: float
    looks: int

    @property
    def complete(self) -> bool:
        """Whether there are as many cycles as the standard asks for."""
        return self.cycles >= CYCLES


def characteristics(
    labels: ArrayLike, commanded: ArrayLike, attained: ArrayLike, directions: Sequence[object] | None = None
) -> Characteristics | None:
    """Terms from visits in the order driven; None where no pose was repeated.

    Parameters
    ----------
    labels : (n,) which pose each visit is of. commanded, attained : (n, 3) positions, m.
    directions : (n,) from where each visit came, anything that can be compared; None where it is not known.
    """
    label = np.asarray(labels)
    error = np.asarray(attained, dtype=float) - np.asarray(commanded, dtype=float)
    names, counts = np.unique(label, return_counts=True)
    repeated = names[counts > 1]
    if not len(repeated):
        return None
    visits = [np.flatnonzero(label == name) for name in repeated]
    looks = [_looks(error[rows]) for rows in visits]
    came = [] if directions is None else [[directions[int(i)] for i in rows] for rows in visits]
    varied = [_between_directions(error[rows], way) for rows, way in zip(visits, came, strict=False)]
    ad, rd, distance = _distance(np.asarray(commanded, dtype=float), np.asarray(attained, dtype=float), visits)
    return Characteristics(
        poses=len(repeated),
        cycles=int(counts[counts > 1].min()),
        ap=max(float(np.linalg.norm(error[rows].mean(axis=0))) for rows in visits),
        rp=max(_repeatability(error[rows]) for rows in visits),
        vap=_largest([v for v, _ in varied]),
        directions=max((n for _, n in varied), default=0),
        ad=ad,
        rd=rd,
        distance=distance,
        dap=_largest([float(np.abs(ap - ap[0]).max()) for ap, _ in looks if len(ap) > 1]),
        drp=_largest([float(np.abs(rp - rp[0]).max()) for _, rp in looks if len(rp) > 1]),
        looks=max(len(ap) for ap, _ in looks),
    )


def _largest(values: Sequence[float]) -> float:
    finite = [v for v in values if np.isfinite(v)]
    return max(finite) if finite else float("nan")


def _repeatability(error: Array) -> float:
    """RP = mean distance from the barycentre plus three standard deviations of it (section 7.2.2)."""
    distance = np.linalg.norm(error - error.mean(axis=0), axis=1)
    return float(distance.mean() + 3.0 * distance.std(ddof=1))


def _looks(error: Array) -> tuple[Array, Array]:
    """AP and RP of consecutive tens of visits (section 7.5)."""
    parts = [error[k : k + LOOK] for k in range(0, len(error) - LOOK + 1, LOOK)]
    return (
        np.array([np.linalg.norm(part.mean(axis=0)) for part in parts]),
        np.array([_repeatability(part) for part in parts]),
    )


def _between_directions(error: Array, directions: Sequence[object]) -> tuple[float, int]:
    """Largest distance between the barycentres of the directions with two visits or more (section 7.2.3)."""
    keys = [str(d) for d in directions]
    centres = [
        error[[k == key for k in keys]].mean(axis=0) for key in dict.fromkeys(keys) if sum(k == key for k in keys) > 1
    ]
    if len(centres) < 2:
        return float("nan"), len(centres)
    points = np.array(centres)
    return float(np.linalg.norm(points[:, None] - points[None], axis=-1).max()), len(centres)


def _distance(commanded: Array, attained: Array, visits: Sequence[NDArray[np.intp]]) -> tuple[float, float, float]:
    """AD, RD and commanded distance between the two repeated poses farthest apart, visit by visit (section 7.3)."""
    if len(visits) < 2:
        return float("nan"), float("nan"), float("nan")
    centres = np.array([commanded[rows].mean(axis=0) for rows in visits])
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    first, second = (int(k) for k in np.unravel_index(int(np.argmax(apart)), apart.shape))
    pairs = min(len(visits[first]), len(visits[second]))
    one, two = visits[first][:pairs], visits[second][:pairs]
    reached = np.linalg.norm(attained[one] - attained[two], axis=1)
    wanted = float(np.linalg.norm(commanded[one] - commanded[two], axis=1).mean())
    return float(reached.mean() - wanted), float(3.0 * reached.std(ddof=1)), wanted

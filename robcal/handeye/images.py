"""Does an image agree with all others? Tests of the twist by which its robot pose would have to be wrong."""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from robcal.handeye.data import BoolArray
from robcal.handeye.problem import Solved
from robcal.handeye.unknowns import Layout
from robcal.transforms import Array

LEVEL = 1e-3
"""Probability with which the worst of all good images is taken for a wrong one."""


@dataclass(frozen=True)
class ImageTwists:
    """What the marks of single images say of the flange, with camera and board as they are.

    ``twist`` (n, 6) best right twist of the flange, ``noise`` (n, 6, 6) its covariance from the marks, ``by_shared``
    (n, 6, a) how it answers to the shared unknowns; NaN in images that carry no twist.
    """

    twist: Array
    noise: Array
    by_shared: Array

    @classmethod
    def of(cls, solved: Solved) -> "ImageTwists":
        """At a solution."""
        system = solved.system
        n = len(system.V)
        diagonal = np.diagonal(system.V, axis1=1, axis2=2)
        scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-300))
        unit = system.V * scale[:, :, None] * scale[:, None, :]
        ok = np.asarray((diagonal > 0).all(axis=1))
        ok[ok] = np.linalg.eigvalsh(unit[ok])[:, 0] > 1e-10
        noise = np.full((n, 6, 6), np.nan)
        noise[ok] = np.linalg.inv(unit[ok]) * scale[ok, :, None] * scale[ok, None, :]
        s = system.s - np.einsum("nai,a->ni", system.G, system.value)
        twist = np.einsum("nij,nj->ni", noise, s)
        return cls(twist, solved.variances.pixel**2 * noise, noise @ np.swapaxes(system.G, 1, 2))

    def statistics(self, solved: Solved, cofactor: Array, used: BoolArray) -> Array:
        """(n,) squared twists in units of what they may be, chi-square with six degrees; NaN without marks.

        Images that took part (``used``) have drawn the solution to themselves, those left out have not.
        """
        shared = self.by_shared @ cofactor @ np.swapaxes(self.by_shared, 1, 2)
        C = self.noise + np.diag(solved.variances.twist**2)
        C = C + np.where(used, -1.0, 1.0)[:, None, None] * shared
        out = np.full(len(C), np.nan)
        ok = np.flatnonzero(np.isfinite(C).all(axis=(1, 2)))
        values, vectors = np.linalg.eigh(C[ok])
        # an image that alone carries some unknown has no redundancy there
        floor = 1e-6 * np.trace(self.noise[ok], axis1=1, axis2=2)[:, None] * 1e-6
        z = np.einsum("nji,nj->ni", vectors, self.twist[ok])
        out[ok] = np.sum(np.where(values > floor, z**2 / np.maximum(values, floor + 1e-300), 0.0), axis=1)
        return out


def critical(images: int) -> float:
    """Statistic that the worst of so many good images exceeds with probability :data:`LEVEL`."""
    freedom = max(6 * images - 12, 6)
    return float(6.0 * stats.f.isf(LEVEL / max(images, 1), 6, freedom))


@dataclass(frozen=True)
class Step:
    """A change of board or camera at an image, as the twists tell it.

    ``image`` first one after, ``kind`` 'board' or 'camera', ``change`` (6,) right twist of Z or X, ``gain`` share of
    the sum of squares that it takes away.
    """

    image: int
    kind: str
    change: Array
    gain: float


def find_step(solved: Solved, twists: ImageTwists, layout: Layout, used: BoolArray) -> Step | None:
    """The change of board or camera that explains most, by generalised least squares of the twists; None if none can.

    Weakness: lens and robot are held, and the changes are taken as small.
    """
    rows = np.flatnonzero(used & np.isfinite(twists.twist).all(axis=1))
    if len(rows) < 6:
        return None
    C = twists.noise[rows] + np.diag(solved.variances.twist**2)
    W = np.linalg.inv(np.linalg.cholesky(C))
    y = np.einsum("nij,nj->ni", W, twists.twist[rows])
    x, z = layout.parts(solved.state)[:2]
    H = W @ twists.by_shared[rows]
    base = H[:, :, [*range(x.start, x.stop), *range(z.start, z.stop)]]
    kinds = {"board": H[:, :, z].reshape(len(rows), 6, -1, 6).sum(axis=2)}
    kinds["camera"] = H[:, :, x].reshape(len(rows), 6, -1, 6).sum(axis=2)
    nothing = _least(y, base)[0]
    best: Step | None = None
    for kind, design in kinds.items():
        for k in range(2, len(rows) - 1):
            late = design * (np.arange(len(rows)) >= k)[:, None, None]
            left, solution = _least(y, np.concatenate([base, late], axis=2))
            gain = 1.0 - left / max(nothing, 1e-300)
            if best is None or gain > best.gain:
                best = Step(int(rows[k]), kind, solution[-6:], gain)
    return best


def _least(y: Array, design: Array) -> tuple[float, Array]:
    flat = design.reshape(-1, design.shape[2])
    scale = np.linalg.norm(flat, axis=0) + 1e-300
    solution = np.linalg.lstsq(flat / scale, y.ravel(), rcond=1e-10)[0]
    left = y.ravel() - (flat / scale) @ solution
    return float(left @ left), solution / scale

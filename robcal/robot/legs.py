"""Legs of a Stewart platform: six lengths that hold a platform over a base.

Leg i runs from a joint ``b_i`` of the base to a joint ``p_i`` of the platform; with the platform at (R, t) its length
is ``|t + R p_i - b_i|``, the indicated length plus the leg's offset. The inverse is this formula; the forward
kinematics solves the six of them by Newton's method (Merlet 2006, *Parallel Robots*, chapters 3 and 4).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robcal.transforms import Array, retract

LEG_KINDS = ("base_x", "base_y", "base_z", "platform_x", "platform_y", "platform_z")
"""Deviations of a leg's joints (m), beside that of its length, ``offset``."""
CONVERGED = 1e-11
ROUNDS = 60
LARGEST_STEP = 0.3
"""Largest step of an iteration: rad, and as a share of the platform's size."""

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Leg:
    """Nominal joints of a leg on base and platform, m, and what is added to its indicated length."""

    base: Point
    platform: Point
    offset: float = 0.0


@dataclass(frozen=True)
class Legs:
    """Six legs as arrays.

    Attributes
    ----------
    base, platform : (6, 3) joints, m. offset : (6,) true minus indicated length, m.
    home : (4, 4) base_T_platform from which the forward kinematics starts.
    """

    base: Array
    platform: Array
    offset: Array
    home: Array

    @classmethod
    def of(cls, legs: Sequence[Leg], home: Array) -> "Legs":
        """From single legs."""
        points = (np.array([leg.base for leg in legs]), np.array([leg.platform for leg in legs]))
        return cls(*points, np.array([leg.offset for leg in legs]), home)

    @property
    def size(self) -> float:
        """Root mean square distance of the platform's joints from their centre, m."""
        return float(np.sqrt(np.mean(np.sum((self.platform - self.platform.mean(axis=0)) ** 2, axis=1))))

    def lengths(self, base_T_platform: Array) -> Array:
        """Indicated lengths (n, 6) of platform frames (n, 4, 4)."""
        return self._vectors(base_T_platform)[1] - self.offset

    def forward(self, lengths: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Platform frames (n, 4, 4) of indicated lengths (n, 6), and which of them exist (converged).

        Weakness: of up to 40 assemblies that have these lengths it gives the one that Newton's steps reach from home.
        """
        T = np.broadcast_to(self.home, (len(lengths), 4, 4)).copy()
        rest = np.full(len(lengths), np.inf)
        for _ in range(ROUNDS):
            residual, A = self.linearised(T, lengths)
            rest = np.max(np.abs(residual), axis=1, initial=0.0)
            if not np.any(rest > CONVERGED):
                break
            step = -np.einsum("nij,nj->ni", np.linalg.pinv(A, rcond=1e-9), residual)
            longest = np.maximum(np.linalg.norm(step[:, :3], axis=1) / self.size, np.linalg.norm(step[:, 3:], axis=1))
            T = retract(T, step * np.minimum(1.0, LARGEST_STEP / np.maximum(longest, 1e-300))[:, None])
        return T, rest < 1e3 * CONVERGED

    def linearised(self, T: Array, lengths: Array) -> tuple[Array, Array]:
        """Length residuals (n, 6), model minus indicated, and their derivative (n, 6, 6) by the platform's twist."""
        d, size = self._vectors(T)
        w = (d / size[..., None]) @ T[:, :3, :3]
        return size - self.offset - lengths, np.concatenate([w, np.cross(self.platform, w)], axis=2)

    def _vectors(self, T: Array) -> tuple[Array, Array]:
        d = self.platform @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3] - self.base
        return d, np.linalg.norm(d, axis=2)


def home_frame(legs: Sequence[Leg], middle: float) -> Array:
    """The platform straight above the base's centre (+z), with legs of ``middle`` indicated length in the mean, m."""
    arrays = Legs.of(legs, np.eye(4))
    T = np.eye(4)
    T[:3, 3] = arrays.base.mean(axis=0) - arrays.platform.mean(axis=0)
    across = T[:3, 3] + arrays.platform - arrays.base
    wanted = float(np.mean((middle + arrays.offset) ** 2))
    T[2, 3] += np.sqrt(max(wanted - float(np.mean(np.sum(across**2, axis=1))), 0.0))
    return T

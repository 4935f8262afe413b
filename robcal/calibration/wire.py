"""A draw-wire: the length that its encoder counts for a point of the world.

Straight, or over a pulley whose unit swivels; the wire may hang through, stretch as it is drawn, and be counted with a
wrong scale or zero. The sag is that of a flat parabola (Irvine 1981, Cable Structures): arc less chord is
``(w L cos e)^2 L / (24 H^2)`` with w the weight a length, e the elevation, H the pull.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from robcal.errors import InvalidInput
from robcal.transforms import Array

GRAVITY = 9.80665
USUAL_TENSION = 5.0
"""N; pull that a draw-wire encoder typically keeps up (makers' data sheets: 2 to 10 N)."""
LIMITS: Mapping[str, float] = {"radius": 0.02, "sag": 1e-4, "stretch": 1e-3, "scale": 2e-3, "offset": 0.01}
"""Parameters of a wire and the largest standard deviations (SI) with which they are worth identifying."""


@dataclass(frozen=True)
class Wire:
    """How a wire's count follows from the point that it is tied to.

    Attributes
    ----------
    radius : m, of a pulley whose unit swivels about the upright axis through the origin; 0: it leaves from a point.
    sag : (kg/m)^2, square of the mass a length; it counts as seen under ``tension``.
    stretch : 1/m; measured is ``d (1 + stretch d)``. scale : measured is ``d (1 + scale)``. offset : m, added.
    axis : upright axis in world coordinates; its length does not matter. tension : N.

    Raises
    ------
    InvalidInput : a negative radius, no tension, or an axis without direction.
    """

    radius: float = 0.0
    sag: float = 0.0
    stretch: float = 0.0
    scale: float = 0.0
    offset: float = 0.0
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    tension: float = USUAL_TENSION

    def __post_init__(self) -> None:
        if not self.radius >= 0 or not np.linalg.norm(self.axis) > 0:
            raise InvalidInput("a pulley needs a radius that is not negative and an axis that has a direction")
        if not self.tension > 0:
            raise InvalidInput("a wire needs a tension above zero")

    def length(self, p: Array) -> tuple[Array, Array]:
        """Counted length (n,) to points (n, 3) of the world in m, and its gradient (n, 3).

        With d the distance and e the elevation over the plane across the axis, the straight part over a pulley is
        ``sqrt(d^2 - r^2)`` and the wheel is touched along ``r (asin(r/d) - e)``; the constant of the count is that of a
        point at elevation zero far away. Weakness: points inside the wheel count as on its rim.
        """
        up, d, u, sine = self._geometry(p)
        straight = np.sqrt(d**2 - self.radius**2)
        length = straight + self.radius * (np.arcsin(self.radius / d) - np.arcsin(sine))
        cosine = np.maximum(np.sqrt(1.0 - sine**2), 1e-9)
        by_elevation = (up - sine[:, None] * u) / (d * cosine)[:, None]
        gradient = (straight / d)[:, None] * u - self.radius * by_elevation
        across = p - (d * sine)[:, None] * up
        pull = self.sag * (GRAVITY / self.tension) ** 2 / 24.0
        level = np.sum(across**2, axis=1)
        length = length + pull * level * d + (self.scale + self.stretch * d) * d + self.offset
        gradient = gradient + pull * (2.0 * d[:, None] * across + level[:, None] * u)
        return length, gradient + (self.scale + 2.0 * self.stretch * d)[:, None] * u

    def by_parameter(self, p: Array, names: tuple[str, ...]) -> Array:
        """Derivatives (n, k) of the counted length by some of the parameters of :data:`LIMITS`."""
        up, d, _, sine = self._geometry(p)
        level = np.sum((p - (d * sine)[:, None] * up) ** 2, axis=1)
        columns = {
            "radius": np.arcsin(self.radius / d) - np.arcsin(sine),
            "sag": (GRAVITY / self.tension) ** 2 / 24.0 * level * d,
            "stretch": d**2,
            "scale": d,
            "offset": np.ones(len(d)),
        }
        return np.stack([columns[name] for name in names], axis=1)

    def _geometry(self, p: Array) -> tuple[Array, Array, Array, Array]:
        """Unit axis (3,), distances (n,), directions (n, 3) and sines of the elevation (n,)."""
        up = np.asarray(self.axis, dtype=float) / np.linalg.norm(self.axis)
        d = np.maximum(np.linalg.norm(p, axis=1), max(self.radius * (1.0 + 1e-9), 1e-12))
        u = p / d[:, None]
        return up, d, u, np.clip(u @ up, -1.0, 1.0)

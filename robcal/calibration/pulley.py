"""A wire that leaves over a pulley: the length that is drawn depends on the direction to the robot."""

from dataclasses import dataclass

import numpy as np

from robcal.errors import InvalidInput
from robcal.transforms import Array


@dataclass(frozen=True)
class Pulley:
    """A wheel whose unit swivels about an upright axis through the origin of the wire's world.

    Attributes
    ----------
    radius : m. axis : upright axis in world coordinates; its length does not matter.

    Raises
    ------
    InvalidInput : the radius is not above zero, or the axis has no direction.
    """

    radius: float
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        if self.radius <= 0 or not np.linalg.norm(self.axis) > 0:
            raise InvalidInput("a pulley needs a radius above zero and an axis that has a direction")

    def length(self, p: Array) -> tuple[Array, Array]:
        """Drawn length (n,) to points (n, 3) of the world in m, and its gradient (n, 3).

        With d the distance and e the elevation over the plane across the axis, the straight part is
        ``sqrt(d^2 - r^2)`` and the wheel is touched along ``r (asin(r/d) - e)``; the constant of the count is that of a
        point at elevation zero far away. Weakness: points inside the wheel count as on its rim.
        """
        up = np.asarray(self.axis, dtype=float) / np.linalg.norm(self.axis)
        d = np.maximum(np.linalg.norm(p, axis=1), self.radius * (1.0 + 1e-9))
        u = p / d[:, None]
        sine = np.clip(u @ up, -1.0, 1.0)
        straight = np.sqrt(d**2 - self.radius**2)
        length = straight + self.radius * (np.arcsin(self.radius / d) - np.arcsin(sine))
        cosine = np.maximum(np.sqrt(1.0 - sine**2), 1e-9)
        by_elevation = (up - sine[:, None] * u) / (d * cosine)[:, None]
        return length, (straight / d)[:, None] * u - self.radius * by_elevation

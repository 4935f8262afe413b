"""Closed loops: the tool's tip held at a point, on a plane, or by a bar of known length.

Nobody measures; what is known takes the place of measurements in the same equations (Bennett and Hollerbach 1991). The
place of point, plane or bar is unknown: each loop has a world of its own, with its origin in the point or the bar's
centre, or its x-y plane in the plane. So the pose of the base in that world takes up what is unknown of the place, and
identification eliminates and names what no loop can tell: the turns of such a world, and with a point alone also the
robot's scale.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.calibration.observations import DistanceObservations, PointObservations
from robcal.errors import InvalidInput
from robcal.transforms import Array, frame, gram_schmidt_frame

KINDS = ("point", "plane", "length")


@dataclass(frozen=True)
class PlaneObservations(DistanceObservations):
    """The tool's origin at a known height over the world's x-y plane.

    Attributes
    ----------
    pose : (m,); distance, sigma : (m,) m, of which the first is the height. wire : not used.
    """

    def __post_init__(self) -> None:
        self._check({"distance": (), "sigma": ()})
        if np.any(self.sigma <= 0):
            raise InvalidInput("PlaneObservations: sigma must be above zero")

    def evaluate(self, T: Array) -> tuple[Array, Array]:
        """``r = height - z``; derivative (m, 1, 6) along the plane's normal, in tool coordinates."""
        at = T[self.pose]
        B = np.zeros((len(at), 1, 6))
        B[:, 0, :3] = at[:, 2, :3]
        return (self.distance - at[:, 2, 3])[:, None], B


def loop_observations(
    kind: str, pose: ArrayLike, value: ArrayLike, sigma: ArrayLike
) -> PointObservations | DistanceObservations:
    """Observations of one closed loop in its own world.

    Parameters
    ----------
    kind : 'point', 'plane' or 'length'. pose : (m,) rows of the poses.
    value : (m,) m: height over the plane, length of the bar; not used for a point. sigma : (m,) m.

    Raises
    ------
    InvalidInput : an unknown kind, or a length that is not positive.
    """
    rows: NDArray[np.int64] = np.asarray(pose, dtype=np.int64)
    values, sigmas = np.asarray(value, dtype=float), np.asarray(sigma, dtype=float)
    if kind == "point":
        zero = np.zeros((len(rows), 3))
        return PointObservations(rows, zero, zero, sigmas[:, None, None] ** 2 * np.eye(3), np.zeros_like(rows))
    if kind == "plane":
        return PlaneObservations(rows, values, sigmas)
    if kind == "length":
        return DistanceObservations(rows, values, sigmas)
    raise InvalidInput(f"a closed loop is of the kind {', '.join(KINDS)}, not '{kind}'")


def loop_world(kind: str, base_tips: Array) -> Array:
    """Start value ``world_T_base`` (4, 4) of a loop's world from the tips (n, 3) that the nominal robot believes.

    Raises
    ------
    DegenerateGeometry : tips on a plane that lie in one line.
    """
    middle = base_tips.mean(axis=0)
    if kind == "point":
        return frame(np.eye(3), -middle)
    if kind == "plane":
        _, _, axes = np.linalg.svd(base_tips - middle)
        world = gram_schmidt_frame(np.array([middle, middle + axes[0], middle + axes[1]]))
        return np.asarray(np.linalg.inv(world), dtype=float)
    # |p - c|^2 is constant: linear in c and the constant
    A = np.column_stack([2.0 * base_tips, np.ones(len(base_tips))])
    centre = np.linalg.lstsq(A, np.sum(base_tips**2, axis=1), rcond=None)[0][:3]
    return frame(np.eye(3), -centre)

"""The unknowns of a hand-eye calibration, what is known of them beforehand, and their normal equations.

All images together have the unknowns in the order of :class:`Layout`; every image has a twist of the flange of its own.
"""

from dataclasses import dataclass

import numpy as np

from robcal.estimation.schur import Normals
from robcal.handeye.data import BoolArray
from robcal.photogrammetry.core.bodies import IntArray
from robcal.photogrammetry.core.camera import Camera
from robcal.transforms import Array


@dataclass(frozen=True)
class State:
    """Values of all unknowns.

    Attributes
    ----------
    X : (h, 4, 4) camera in its carrier; Z : (g, 4, 4) board in its carrier: one, or one before and one after a move.
    shape : (4,) deviations of the board; robot : (p,) deviations of the robot.
    twist : (n, 6) by which the flange misses in each image, on the right of ``base_T_flange``.
    """

    camera: Camera
    X: Array
    Z: Array
    shape: Array
    robot: Array
    twist: Array


@dataclass(frozen=True)
class Variances:
    """Variance components: pixels over what is stated, twist of the flange, deviations of the robot."""

    pixel: float = 1.0
    place: float = 0.0
    turn: float = 0.0
    robot_place: float = 0.0
    robot_turn: float = 0.0

    @property
    def twist(self) -> Array:
        """(6,) standard deviations of a twist."""
        return np.array([self.place] * 3 + [self.turn] * 3)


@dataclass(frozen=True)
class Layout:
    """Which unknowns are free: ``[X.. | Z.. | lens | shape | robot]``.

    Attributes
    ----------
    of_X, of_Z : (n,) which X and Z an image is seen with.
    lens, shape : (k,), (s,) which interior orientation and deviations of the board are free; robot : all of them.
    """

    of_X: IntArray
    of_Z: IntArray
    lens: IntArray
    shape: IntArray
    robot: bool = False

    def sizes(self, state: State) -> tuple[int, int, int, int, int]:
        """Columns of X, Z, lens, shape, robot."""
        robot = len(state.robot) if self.robot else 0
        return 6 * len(state.X), 6 * len(state.Z), len(self.lens), len(self.shape), robot

    def parts(self, state: State) -> tuple[slice, slice, slice, slice, slice]:
        """Where the columns of X, Z, lens, shape, robot are."""
        a, b, c, d, e = np.cumsum(self.sizes(state)).tolist()
        return slice(0, a), slice(a, b), slice(b, c), slice(c, d), slice(d, e)


@dataclass(frozen=True)
class System:
    """Normal equations in pixels as stated: residuals as if no twist and no deviation with a prior had been taken out.

    ``A`` (a, a), ``b`` (a,) of the shared unknowns, ``G`` (n, a, 6) mixed, ``V`` (n, 6, 6), ``s`` (n, 6) of the
    twists, ``square`` sum of squares, ``rows`` number of residuals; ``prior`` (a,) standard deviations of the shared
    unknowns about zero, infinite without, ``value`` (a,) their values where they have a prior, else zero.
    """

    A: Array
    b: Array
    G: Array
    V: Array
    s: Array
    square: float
    rows: int
    value: Array
    prior: Array
    place: BoolArray
    turn: BoolArray

    def sigmas(self, variances: Variances) -> Array:
        """(a,) standard deviations of the unknowns about zero; those of the robot are variance components."""
        return components(self.prior, self.place, self.turn, variances)


def reduced(system: System, variances: Variances) -> Normals:
    """Normal equations in units of the variance components; twists in their standard deviations."""
    w, L = variances.pixel**-2.0, variances.twist
    prior = system.sigmas(variances) ** -2.0
    A = w * system.A
    A[np.diag_indices_from(A)] += prior
    V = w * system.V * L[:, None] * L + np.eye(6)
    return Normals(A, w * system.G * L, V, w * system.b, w * system.s * L)


def quadratic(system: System, variances: Variances, prior: Array, x: Array, units: Array) -> float:
    """Half the sum of squares that the linear problem has at shared unknowns ``x`` and twists ``units``."""
    twist = units * variances.twist
    square = system.square - 2.0 * (system.b @ x + np.sum(system.s * twist))
    square += x @ system.A @ x + 2.0 * np.einsum("a,nai,ni->", x, system.G, twist)
    square += np.einsum("ni,nij,nj->", twist, system.V, twist)
    return 0.5 * float(square / variances.pixel**2 + np.sum(prior * x * x) + np.sum(units**2))


def expected_lens(camera: Camera) -> Array:
    """Interior orientation that weak priors are about: no distortion, principal point as at the start."""
    vector = camera.vector
    vector[4:] = 0.0
    return vector


def lens_priors(camera: Camera) -> Array:
    """Standard deviations of the interior orientation that hold what few images leave open: wide for any lens.

    Focal lengths none; principal point a twentieth of the image about its start; distortion coefficients one unit
    (radial) and a twentieth (tangential).
    """
    sizes = {"fx": np.inf, "fy": np.inf, "cx": 0.05 * camera.width, "cy": 0.05 * camera.height}
    small = {"p1": 0.05, "p2": 0.05, "s1": 0.05, "s2": 0.05, "s3": 0.05, "s4": 0.05}
    return np.array([{**sizes, **small}.get(name, 1.0) for name in camera.names])


def components(prior: Array, place: BoolArray, turn: BoolArray, variances: Variances) -> Array:
    """Standard deviations (a,) with those of the robot's lengths and angles from the variance components."""
    out = prior.copy()
    out[place], out[turn] = variances.robot_place, variances.robot_turn
    return out

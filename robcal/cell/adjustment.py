"""Least squares of touches: unknown frames and points against a robot whose errors are known by their covariance.

Each equation says that a coordinate of a touched point is zero. What makes it differ from zero is the touch itself,
what moves the joints without being in the model (both independent from touch to touch), and the errors of the robot's
parameters and of the tool, which all touches share: ``V = s^2 U + K + H C H'``. Where the noise ``s`` of a touch is not
stated it is estimated by restricted maximum likelihood (Patterson and Thompson 1971), and intervals take Student's
distribution with the degrees of freedom of the mixture (Satterthwaite 1946).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize, special, stats

from robcal.cell.carried import CarriedFrames
from robcal.errors import NotIdentifiable
from robcal.estimation.gauss_newton import gauss_newton
from robcal.transforms import Array

State = TypeVar("State")

ASSUMED_TOUCH = 1e-4
"""Standard deviation (m) of a touch, where none is stated and none can be estimated."""
LEAST_TOUCH, MOST_TOUCH = 1e-6, 0.1
"""Range (m) in which the noise of a touch is sought."""
WRONG_TOOL = 1e-4
"""Probability by chance below which a displaced tool counts as found."""
ABSORBED = 0.05
"""A shift of the tool of which the unknowns absorb all but this share cannot be told."""


@dataclass(frozen=True)
class Equations:
    """Misclosures at a state.

    Attributes
    ----------
    f : (m,) misclosure; A : (m, p) derivative by the unknowns; touch : (m,) row of the touch.
    B : (m, 6) derivative by the right twist of the carried frame.
    unit : (m, m) covariance of the touches' own noise for unit ``s``; None for independent rows.
    """

    f: Array
    A: Array
    B: Array
    touch: NDArray[np.int64]
    unit: Array | None = None


@dataclass(frozen=True)
class Adjusted:
    """Result of an adjustment.

    Attributes
    ----------
    covariance : (p, p) of the unknowns; of_touches : (p, p) the part that comes from the touches' own noise.
    with_robot : (p, k) covariance with the errors common to all poses.
    touch_sigma : standard deviation of a touch (m) that was used; freedom : its degrees of freedom, infinite if stated.
    sigma0 : root of the whitened sum of squares over the redundancy with the noise stated, or assumed.
    f : (m,) misclosures at the solution, touch : (m,) their touches.
    shift : (3,) by which another tool would explain the touches better, m in tool coordinates; None where none does.
    """

    covariance: Array
    of_touches: Array = field(repr=False)
    with_robot: Array = field(repr=False)
    touch_sigma: float
    freedom: float
    redundancy: int
    sigma0: float
    f: Array = field(repr=False)
    touch: NDArray[np.int64] = field(repr=False)
    shift: Array | None = None
    shift_sigma: Array | None = None

    def touch_residuals(self, n: int) -> Array:
        """Length (n,) of the misclosure of each touch, m."""
        return np.sqrt(np.bincount(self.touch, weights=self.f**2, minlength=n))


def student_factor(covariance: Array, of_touches: Array, freedom: float) -> Array:
    """Half width of 95 % intervals in units of the standard deviations (p,).

    Degrees of freedom of a sum of a known variance and an estimated one by Satterthwaite (1946).
    """
    total, estimated = np.diag(covariance), np.diag(of_touches)
    share = np.divide(estimated, total, out=np.zeros_like(total), where=total > 0)
    if not np.isfinite(freedom):
        return np.full(len(total), float(stats.norm.ppf(0.975)))
    return np.asarray(stats.t.ppf(0.975, freedom / np.maximum(share, 1e-6) ** 2))


def adjust(
    linearise: Callable[[State], Equations],
    retract: Callable[[State, Array], State],
    start: State,
    carried: CarriedFrames,
    touch_sigma: float | None = None,
) -> tuple[State, Adjusted]:
    """Adjust unknowns to touches.

    Parameters
    ----------
    touch_sigma : standard deviation of a touch, m; None to estimate it.

    Raises
    ------
    NotIdentifiable : fewer equations than unknowns.
    """
    sigma, state = touch_sigma or ASSUMED_TOUCH, start
    at = linearise(state)
    m, p = at.A.shape
    if m < p:
        raise NotIdentifiable(f"{m} equations for {p} unknowns: touch more points, or more often")
    freedom = np.inf
    for _ in range(2):  # covariances follow the state only weakly
        state = _solved(linearise, retract, state, _covariance(at, carried, sigma))
        at = linearise(state)
        if touch_sigma is None and m > p:
            sigma, freedom = _estimated_sigma(at, carried), float(m - p)
    V = _covariance(at, carried, sigma)
    white, A, f = _whitened(V, at)
    cofactor = np.asarray(np.linalg.inv(A.T @ A), dtype=float)
    gain = cofactor @ A.T @ white
    stated = _whitened(_covariance(at, carried, touch_sigma or ASSUMED_TOUCH), at)[2]
    shift, shift_sigma = _displaced_tool(at, white, A, f, freedom)
    return state, Adjusted(
        covariance=cofactor,
        of_touches=sigma**2 * (gain @ _unit(at) @ gain.T),
        with_robot=-gain @ _shared(at, carried) @ carried.covariance,
        touch_sigma=sigma,
        freedom=freedom,
        redundancy=m - p,
        sigma0=float(np.sqrt(stated @ stated / (m - p))) if m > p else 1.0,
        f=at.f,
        touch=at.touch,
        shift=shift,
        shift_sigma=shift_sigma,
    )


def _solved(
    linearise: Callable[[State], Equations], retract: Callable[[State, Array], State], state: State, V: Array
) -> State:
    L = np.linalg.cholesky(V)

    def white(x: Array) -> Array:
        return np.asarray(linalg.solve_triangular(L, x, lower=True, check_finite=False))

    def linear(at: State) -> tuple[Array, Array]:
        equations = linearise(at)
        return -white(equations.f), white(equations.A)

    return gauss_newton(linear, lambda at: -white(linearise(at).f), retract, state)[0]


def _unit(at: Equations) -> Array:
    return np.eye(len(at.f)) if at.unit is None else at.unit


def _shared(at: Equations, carried: CarriedFrames) -> Array:
    """Derivative (m, k) of the misclosures by the errors that all poses share."""
    return np.asarray(np.einsum("mi,mik->mk", at.B, carried.J[at.touch]))


def _known(at: Equations, carried: CarriedFrames) -> Array:
    same = at.touch[:, None] == at.touch[None, :]
    turned = np.einsum("mi,mij->mj", at.B, carried.scatter[at.touch])
    H = _shared(at, carried)
    return np.where(same, turned @ at.B.T, 0.0) + H @ carried.covariance @ H.T


def _covariance(at: Equations, carried: CarriedFrames, sigma: float) -> Array:
    return _known(at, carried) + sigma**2 * _unit(at)


def _whitened(V: Array, at: Equations) -> tuple[Array, Array, Array]:
    """Whitener (m, m) and the design and the best fitting residuals it makes."""
    L = np.linalg.cholesky(V)
    white = np.asarray(linalg.solve_triangular(L, np.eye(len(V)), lower=True, check_finite=False))
    A, f = white @ at.A, white @ at.f
    return white, A, f - A @ np.linalg.lstsq(A, f, rcond=None)[0]


def _estimated_sigma(at: Equations, carried: CarriedFrames) -> float:
    known = _known(at, carried)
    unit = _unit(at)

    def criterion(log_sigma: float) -> float:
        V = known + np.exp(2.0 * log_sigma) * unit
        L = np.linalg.cholesky(V)
        A, f = (linalg.solve_triangular(L, x, lower=True, check_finite=False) for x in (at.A, at.f))
        Q, R = np.linalg.qr(A)
        left = f - Q @ (Q.T @ f)
        return float(2 * np.log(np.diag(L)).sum() + 2 * np.log(np.abs(np.diag(R))).sum() + left @ left)

    found = optimize.minimize_scalar(
        criterion, bounds=(np.log(LEAST_TOUCH), np.log(MOST_TOUCH)), method="bounded", options={"xatol": 1e-3}
    )
    return float(np.exp(found.x))


def _displaced_tool(
    at: Equations, white: Array, A: Array, f: Array, freedom: float
) -> tuple[Array, Array] | tuple[None, None]:
    """Shift (3,) of the carried frame's origin that explains the residuals, and its standard deviations.

    Test of three further unknowns: chi-square where the noise is stated, else Fisher's F.
    """
    extra = white @ at.B[:, :3]
    Q = np.linalg.qr(A)[0]
    left = extra - Q @ (Q.T @ extra)
    redundancy = len(f) - A.shape[1]
    size = np.linalg.norm(extra, axis=0).max(initial=0.0)
    if redundancy < 4 or size == 0.0 or np.linalg.svd(left, compute_uv=False)[-1] < ABSORBED * size:
        return None, None
    N = left.T @ left
    b = -left.T @ f
    shift = np.asarray(np.linalg.solve(N, b), dtype=float)
    gain, rest = float(b @ shift), max(float(f @ f) - float(b @ shift), 1e-300)
    if np.isfinite(freedom):
        chance = float(special.fdtrc(3, redundancy - 3, (gain / 3) / (rest / (redundancy - 3))))
        variance = rest / (redundancy - 3)
    else:
        chance, variance = float(special.chdtrc(3, gain)), 1.0
    if chance > WRONG_TOOL:
        return None, None
    return shift, np.sqrt(variance * np.diag(np.linalg.inv(N)))

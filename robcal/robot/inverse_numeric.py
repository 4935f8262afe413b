"""Numeric inverse kinematics for any chain: damped least squares from many starts, deterministic.

Source of the damping: Levenberg-Marquardt on the twist ``difference(K(q), F)``, as in Sugihara (2011), *Solvability-
unconcerned inverse kinematics*; all poses and starts advance together.

Weakness: a multi-start search finds all branches only with high probability; for redundant arms the solutions are a
continuum of which the one near each start is found.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from robcal.estimation.batched import Damping, NormalEquations, minimise_each
from robcal.estimation.summary import TerminationSettings
from robcal.robot.chain import Chain, forward, forward_and_jacobian
from robcal.transforms import Array, difference

BoolArray = NDArray[np.bool_]
DAMPING = Damping(start=1e-3, shrink=0.2, grow=8.0, largest=1e8)
Evaluate = Callable[[Array, NDArray[np.int_]], tuple[Array, Array]]


@dataclass(frozen=True)
class NumericSettings:
    """Settings of the numeric inverse.

    Attributes
    ----------
    starts : number of start configurations for a search of all branches.
    iterations : most steps from one start.
    tolerance : norm of the weighted twist at which a frame counts as reached, m.
    rotation_length : m; one radian of rotation counts as much as this length.
    tilt_tolerance : rad; an arm of fewer than six joints cannot follow every orientation: it takes the position exactly
        and comes as near as it can in orientation, and that counts as reached up to this angle.
    """

    starts: int = 48
    iterations: int = 80
    tolerance: float = 1e-9
    rotation_length: float = 0.3
    tilt_tolerance: float = 0.02

    def weight(self, chain: Chain) -> Array:
        """Weights (6,) of a twist; with fewer than six joints position goes before orientation."""
        length = self.rotation_length if chain.n_joints >= 6 else 1e-3
        return np.array([1.0] * 3 + [length] * 3)

    def reached(self, chain: Chain, twist: Array) -> BoolArray:
        """Whether frames with these twists (n, 6) left count as reached."""
        if chain.n_joints >= 6:
            return np.linalg.norm(self.weight(chain) * twist, axis=-1) < self.tolerance
        position, turn = np.linalg.norm(twist[:, :3], axis=1), np.linalg.norm(twist[:, 3:], axis=1)
        return (position < 1e-7) & (turn < self.tilt_tolerance)


def start_configurations(chain: Chain, count: int) -> Array:
    """Deterministic starts (count, N) spread over the limits (unknown limits: one turn, one metre)."""
    half = np.where(chain.prismatic, 1.0, np.pi)
    lower = np.where(np.isfinite(chain.lower), chain.lower, -half)
    upper = np.where(np.isfinite(chain.upper), chain.upper, half)
    # more than one turn of a joint holds no further branch
    centre, span = 0.5 * (lower + upper), upper - lower
    span = np.where(chain.prismatic, span, np.minimum(span, 2.0 * np.pi))
    unit = qmc.Halton(chain.n_joints, scramble=True, rng=np.random.default_rng(20060101)).random(count)
    return centre + (unit - 0.5) * span


def refine(
    chain: Chain,
    base_T_flange: Array,
    start: Array,
    settings: NumericSettings,
    *,
    within_limits: bool = False,
    evaluate: Evaluate | None = None,
) -> tuple[Array, Array]:
    """Joint values (n, N) that bring each row's flange as near as possible to its frame, and the twist left (n, 6).

    ``within_limits`` keeps every step inside the joint limits (a projected step), for the nearest reachable pose.
    ``evaluate(q, rows)`` gives frames and their right-twist Jacobian for the given rows; default: the nominal chain.
    """
    at: Evaluate = evaluate if evaluate is not None else lambda values, _: forward_and_jacobian(chain, values)
    inside = (lambda q: np.clip(q, chain.lower, chain.upper)) if within_limits else (lambda q: q)
    weight = settings.weight(chain)

    def equations(q: Array, rows: NDArray[np.int_]) -> NormalEquations:
        T, J = at(q, rows)
        Jw, r = weight[:, None] * J, weight * difference(T, base_T_flange[rows])
        turned = np.swapaxes(Jw, 1, 2)
        normal, right = turned @ Jw, (turned @ r[..., None])[..., 0]
        if within_limits:
            # joints that rest on a limit and are pushed against it take no part in the next step
            held = ((q <= chain.lower) & (right < 0)) | ((q >= chain.upper) & (right > 0))
            right = np.where(held, 0.0, right)
            normal = np.where(held[:, :, None] | held[:, None, :], 0.0, normal)
        return NormalEquations(normal, right, np.sum(r**2, axis=1))

    def moved(q: Array, step: Array) -> Array:
        largest = np.max(np.abs(step), axis=1, keepdims=True)
        return inside(q + step * np.minimum(1.0, 1.0 / np.maximum(largest, 1e-300)))

    termination = TerminationSettings(settings.iterations, negligible=(0.01 * settings.tolerance) ** 2)
    found = minimise_each(equations, moved, inside(np.array(start)), termination, DAMPING, _damped_step)
    q = found.state
    T = forward(chain, q) if evaluate is None else evaluate(q, np.arange(len(q)))[0]
    return q, difference(T, base_T_flange)


def _damped_step(equations: NormalEquations, damping: Array) -> Array:
    """Steps (n, N) damped by the size of the residual (Sugihara 2011), so that the last ones are undamped."""
    normal = equations.matrix.copy()
    at = np.arange(normal.shape[-1])
    normal[:, at, at] += (damping * np.maximum(np.sqrt(equations.cost), 1e-12) + 1e-14)[:, None]
    return np.asarray(np.linalg.solve(normal, equations.right[..., None])[..., 0])


def search(chain: Chain, base_T_flange: Array, near: Array, settings: NumericSettings, *, all_branches: bool) -> Array:
    """Solutions (n, B, N), padded with NaN.

    The start near the given configuration comes first; further starts are spent on rows it does not solve, or on all
    rows with ``all_branches``.
    """
    n, count = len(base_T_flange), chain.n_joints
    q, r = refine(chain, base_T_flange, near, settings)
    solved = settings.reached(chain, r) & chain.closes(q)
    inside = np.all((q >= chain.lower - 1e-9) & (q <= chain.upper + 1e-9), axis=1)
    rows = np.arange(n) if all_branches else np.flatnonzero(~(solved & inside))
    found: list[list[Array]] = [[q[i]] if solved[i] else [] for i in range(n)]
    if len(rows):
        starts = start_configurations(chain, settings.starts)
        many = np.repeat(rows, len(starts))
        q_many, r_many = refine(chain, base_T_flange[many], np.tile(starts, (len(rows), 1)), settings)
        good = settings.reached(chain, r_many) & chain.closes(q_many)
        for i, solution in zip(many[good], q_many[good], strict=True):
            if not any(_same(chain, solution, known) for known in found[i]):
                found[i].append(solution)
    width = max(1, max((len(f) for f in found), default=1))
    out = np.full((n, width, count), np.nan)
    for i, solutions in enumerate(found):
        for k, solution in enumerate(solutions):
            out[i, k] = solution
    return out


def nearest_pose(chain: Chain, base_T_flange: Array, near: Array, settings: NumericSettings) -> tuple[Array, Array]:
    """Joint values within the limits whose flange comes nearest to one frame (4, 4), and the twist left (6,)."""
    starts = np.vstack([near[None], start_configurations(chain, settings.starts)])
    frames = np.broadcast_to(base_T_flange, (len(starts), 4, 4))
    q, r = refine(chain, frames, starts, settings, within_limits=True)
    best = int(np.argmin(np.linalg.norm(settings.weight(chain) * r, axis=1)))
    return q[best], r[best]


def _same(chain: Chain, a: Array, b: Array) -> bool:
    gap = a - b
    gap = np.where(chain.prismatic, gap, np.angle(np.exp(1j * gap)))
    return bool(np.max(np.abs(gap)) < 1e-5)

"""Points from the readings of three or more linear cameras, with the noise of each and what the system shares."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from robcal.estimation.batched import NormalEquations, minimise_each
from robcal.estimation.grouping import IntArray, members, sum_by
from robcal.estimation.summary import TerminationSettings
from robcal.photogrammetry.line_cameras.camera import NUMBERS, LineCameraSystem, Readings, read_each
from robcal.transforms import Array

LEAST_ANGLE = 1e-3
"""Smallest by largest eigenvalue of the sum of the planes' normals below which they meet in a line."""
SETTINGS = TerminationSettings(max_iterations=30, cost_tolerance=1e-12, negligible=1e-8)


@dataclass(frozen=True)
class LightPoints:
    """Lights in the world.

    Attributes
    ----------
    p_world : (n, 3) m, NaN where it has none.
    covariance : (n, 3, 3) m^2 from the noise of the readings alone.
    jacobian : (n, 3, 9 c) derivative by the numbers of the system; its covariance moves all points together.
    n_cameras : (n,) readings used; chi2 : (n,) of redundancy ``n_cameras - 3``.
    used : (m,) readings that stayed.
    reasons : by light, why it has no point.
    """

    p_world: Array
    covariance: Array
    jacobian: Array
    n_cameras: IntArray
    chi2: Array
    used: NDArray[np.bool_]
    reasons: dict[int, str]


def intersect_planes(system: LineCameraSystem, readings: Readings, critical: float = 4.0) -> LightPoints:
    """Intersect the planes of each light.

    With five readings or more the one that contradicts the others (beyond ``critical`` standard deviations) is left
    out; with four a contradiction shows but not whose it is, so the light is; with three nothing is redundant.
    """
    used = np.ones(len(readings.u), dtype=bool)
    reasons: dict[int, str] = {}
    while True:
        found = _intersect(system, readings, used, reasons)
        limit = stats.chi2.isf(2.0 * stats.norm.sf(critical), np.maximum(found.n_cameras - 3, 1))
        bad = 0
        for light in np.flatnonzero((found.n_cameras > 3) & (found.chi2 > limit)):
            rows = np.flatnonzero((readings.point == light) & used)
            chi2 = _contradiction(system, readings, rows, found.p_world[light])
            if chi2 <= limit[light]:
                continue
            bad += 1
            if len(rows) >= 5:
                used[_most_helpful(system, readings, rows)] = False
            else:
                used[rows] = False
                reasons[int(light)] = f"its four planes miss one another by {np.sqrt(chi2):.1f} standard deviations"
        if not bad:
            return found


def _contradiction(system: LineCameraSystem, readings: Readings, rows: IntArray, p: Array) -> float:
    """Chi-square of a light's misclosures, with what the system's uncertainty allows them."""
    camera, width = readings.camera[rows], len(NUMBERS)
    u, by_point, by_numbers = read_each(system.cameras, camera, np.tile(p, (len(rows), 1)))
    B = np.zeros((len(rows), width * len(system.cameras)))
    for i, k in enumerate(camera):
        B[i, width * k : width * (k + 1)] = by_numbers[i]
    across = np.linalg.svd(by_point)[0][:, 3:]
    z = across.T @ (readings.u[rows] - u)
    covariance = across.T @ (np.diag(readings.sigma[rows] ** 2) + B @ system.covariance @ B.T) @ across
    return float(z @ np.linalg.solve(covariance, z))


def _most_helpful(system: LineCameraSystem, readings: Readings, rows: IntArray) -> int:
    """The reading without which the others agree best."""
    costs = []
    for row in rows:
        rest = rows[rows != row]
        alone = Readings(np.zeros(len(rest), int), readings.camera[rest], readings.u[rest], readings.sigma[rest])
        chi2 = _intersect(system, alone, np.ones(len(rest), dtype=bool), {}).chi2[0]
        costs.append(chi2 if np.isfinite(chi2) else np.inf)
    return int(rows[int(np.argmin(costs))])


def _intersect(
    system: LineCameraSystem, readings: Readings, used: NDArray[np.bool_], reasons: dict[int, str]
) -> LightPoints:
    n = readings.n
    start, count = _start(system, readings, used)
    whole = np.flatnonzero(np.isfinite(start).all(axis=1))

    def equations(x: Array, lights: IntArray) -> NormalEquations:
        rows, place = members(readings.point, whole[lights], n)
        rows, place = rows[used[rows]], place[used[rows]]
        u, by_point, _ = read_each(system.cameras, readings.camera[rows], x[place])
        w = 1.0 / readings.sigma[rows]
        return NormalEquations.of_rows(
            place, (w * (readings.u[rows] - u))[:, None], (w[:, None] * by_point)[:, None], len(lights)
        )

    solved = minimise_each(equations, lambda x, step: x + step, start[whole], SETTINGS)
    p, covariance, chi2 = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan), np.full(n, np.nan)
    good = np.isfinite(solved.equations.cost)
    p[whole[good]], chi2[whole[good]] = solved.state[good], solved.equations.cost[good]
    covariance[whole[good]] = solved.equations.select(good).inverse()
    bad = ~np.isfinite(covariance).all(axis=(1, 2))
    p[bad] = np.nan
    _tell(reasons, bad, count)
    return LightPoints(
        p, covariance, _by_system(system, readings, used, p, covariance), count, chi2, used.copy(), reasons
    )


def _start(system: LineCameraSystem, readings: Readings, used: NDArray[np.bool_]) -> tuple[Array, IntArray]:
    """Points (n, 3) nearest to the planes, NaN where these do not fix one, and the planes (n,) of each."""
    normal, offset = np.empty((len(readings.u), 3)), np.empty(len(readings.u))
    for k, camera in enumerate(system.cameras):
        rows = readings.camera == k
        normal[rows], offset[rows] = camera.planes(readings.u[rows])
    used &= np.isfinite(offset)
    on = np.where(used[:, None], normal, 0.0)
    N = sum_by(readings.point, on[:, :, None] * on[:, None, :], readings.n)
    b = sum_by(readings.point, on * np.where(used, offset, 0.0)[:, None], readings.n)
    count = np.bincount(readings.point[used], minlength=readings.n).astype(np.int64)
    values = np.linalg.eigvalsh(N)
    regular = (count >= 3) & (values[:, 0] > LEAST_ANGLE**2 * values[:, 2])
    p = np.full((readings.n, 3), np.nan)
    p[regular] = np.linalg.solve(N[regular], b[regular][..., None])[..., 0]
    return p, count


def _by_system(
    system: LineCameraSystem, readings: Readings, used: NDArray[np.bool_], p: Array, covariance: Array
) -> Array:
    """Derivative (n, 3, 9 c) of the points: ``-C A' W B`` with A, B the derivatives by point and by the system."""
    width = len(NUMBERS)
    out = np.zeros((readings.n, 3, width * len(system.cameras)))
    _, by_point, by_numbers = read_each(system.cameras, readings.camera, p[readings.point])
    moved = covariance[readings.point] @ by_point[..., None] / readings.sigma[:, None, None] ** 2
    share = -moved * by_numbers[:, None, :]
    share[~used | ~np.isfinite(share).all(axis=(1, 2))] = 0.0
    for k in range(len(system.cameras)):
        rows = readings.camera == k
        out[:, :, width * k : width * (k + 1)] = sum_by(readings.point[rows], share[rows], readings.n)
    return out


def _tell(reasons: dict[int, str], bad: NDArray[np.bool_], count: IntArray) -> None:
    for light in np.flatnonzero(bad):
        few = f"{int(count[light])} of the cameras saw it: three planes make a point"
        reasons.setdefault(int(light), few if count[light] < 3 else "its planes meet in a line or behind a camera")

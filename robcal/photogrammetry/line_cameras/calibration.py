"""Calibration of a system of linear cameras against lights at known places.

Each camera starts from the linear relation of readings and places (the direct linear transformation of Abdel-Aziz and
Karara 1971, in one dimension), with the sum of absolute misclosures minimised by re-weighting (Schlossmacher 1973). All
are then adjusted together. A place that is known to ``C`` adds ``G C G'`` to the covariance of its readings (``G``:
their derivative by the place), which is what adjusting the place with a prior comes to.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from robcal.errors import DegenerateGeometry
from robcal.estimation.covariance import cofactor, global_test
from robcal.estimation.gauss_newton import gauss_newton
from robcal.estimation.summary import SolveSummary, TerminationSettings
from robcal.photogrammetry.line_cameras.camera import NUMBERS, LineCamera, LineCameraSystem, Readings, read_each
from robcal.transforms import Array, frame, invert

LEAST_PLACES = 12
"""Places a camera must have seen: nine numbers, and some to contradict them."""
FLAT = 0.03
"""Third by first extent of the places below which they lie in a plane."""
CRITICAL = 4.0
"""Residuals beyond so many standard deviations are gross errors."""
START_CRITICAL = 10.0
"""The same beside the start, which knows no distortion."""
MOST_ROUNDS = 20
MOST_REJECTED = 0.2
LEVEL = 0.01
SETTINGS = TerminationSettings(max_iterations=50, negligible=1e-4)


@dataclass(frozen=True)
class CalibratedLineCameras:
    """A calibrated system.

    Attributes
    ----------
    system : with the covariance of all numbers.
    sigma0 : of the adjustment with the stated uncertainties; p_value : of residuals that large.
    factor : by which the stated standard deviations were multiplied (1 where the residuals do not contradict them).
    residual : (m,) px, measured minus model; rejected : (m,) readings left out.
    """

    system: LineCameraSystem
    sigma0: float
    p_value: float
    factor: float
    residual: Array
    rejected: NDArray[np.bool_]
    summary: SolveSummary


def calibrate(
    names: Sequence[str], readings: Readings, places: Array, covariance: Array, *, stated: bool = True
) -> CalibratedLineCameras:
    """Calibrate a system.

    Parameters
    ----------
    names : of the cameras, in the order of the readings' numbers.
    places : (n, 3) m, of the readings' lights; covariance : (n, 3, 3) m^2 of these, zero where they count as exact.
    stated : false: sigmas of the readings are relative, their size follows from the residuals.

    Raises
    ------
    DegenerateGeometry : too few places, or places in a plane; the message says what to add.
    """
    start = []
    for k, name in enumerate(names):
        rows = readings.camera == k
        start.append(_direct(name, readings.u[rows], places[readings.point[rows]]))
    at = places[readings.point]
    off = readings.u - read_each(tuple(start), readings.camera, at)[0]
    rejected = _far(off, readings.camera, len(names), START_CRITICAL)
    for _ in range(MOST_ROUNDS):
        problem = _Problem(readings, places, covariance, ~rejected)
        cameras, summary = gauss_newton(problem.linearise, problem.residuals, _moved, tuple(start), SETTINGS)
        left = readings.u - read_each(cameras, readings.camera, at)[0]
        size = left / problem.sigma(cameras)
        far = _far(size, readings.camera, len(names), CRITICAL, least=1.0)
        far &= rejected | (np.abs(size) > 0.5 * np.abs(size[~rejected]).max())
        if (far == rejected).all() or np.mean(far) > MOST_REJECTED:
            break
        rejected = far
    r, J = problem.linearise(cameras)
    sigma0, p_value = global_test(summary.cost, len(r) - J.shape[1])
    factor = sigma0 if not stated or p_value < LEVEL or p_value > 1.0 - LEVEL else 1.0
    noise = float(np.sqrt(np.mean(readings.sigma**2))) * factor
    ranges = [readings.u[(readings.camera == k) & ~rejected] for k in range(len(names))]
    cameras = tuple(
        replace(c, calibrated=(float(u.min()), float(u.max()))) for c, u in zip(cameras, ranges, strict=True)
    )
    system = LineCameraSystem(tuple(names), cameras, factor**2 * cofactor(J), noise)
    return CalibratedLineCameras(system, sigma0, p_value, factor, left, rejected, summary)


def _far(length: Array, camera: np.ndarray, n: int, critical: float, least: float = 0.0) -> NDArray[np.bool_]:
    """Residuals beyond ``critical`` times the scatter of their own camera, which is ``least`` at least."""
    scatter = [max(least, float(np.median(np.abs(length[camera == k])) / stats.norm.isf(0.25))) for k in range(n)]
    return np.asarray(~(np.abs(length) <= critical * np.array(scatter)[camera]))


def _moved(cameras: tuple[LineCamera, ...], step: Array) -> tuple[LineCamera, ...]:
    width = len(NUMBERS)
    return tuple(camera.moved(step[width * k : width * (k + 1)]) for k, camera in enumerate(cameras))


@dataclass(frozen=True)
class _Problem:
    readings: Readings
    places: Array
    covariance: Array
    used: NDArray[np.bool_]

    def residuals(self, cameras: tuple[LineCamera, ...]) -> Array:
        return self.linearise(cameras)[0]

    def sigma(self, cameras: tuple[LineCamera, ...]) -> Array:
        """(m,) standard deviations of single residuals, px."""
        point = self.readings.point
        _, G, _ = read_each(cameras, self.readings.camera, self.places[point])
        return np.sqrt(self.readings.sigma**2 + np.einsum("mi,mij,mj->m", G, self.covariance[point], G))

    def linearise(self, cameras: tuple[LineCamera, ...]) -> tuple[Array, Array]:
        """Residuals and Jacobian whitened place by place, as the readings of a place share its error."""
        width, count = len(NUMBERS), len(cameras)
        point, camera = self.readings.point[self.used], self.readings.camera[self.used]
        u, G, by_numbers = read_each(cameras, camera, self.places[point])
        n, rows = len(self.places), (point, camera)
        r, J = np.zeros((n, count)), np.zeros((n, count, count, width))
        by_place, sigma = np.zeros((n, count, 3)), np.ones((n, count))
        r[rows] = self.readings.u[self.used] - u
        J[point, camera, camera] = by_numbers
        by_place[rows] = G
        sigma[rows] = self.readings.sigma[self.used]
        C = by_place @ self.covariance @ np.swapaxes(by_place, 1, 2)
        C[:, np.arange(count), np.arange(count)] += sigma**2
        if not np.isfinite(C).all():
            return np.full(len(point), np.nan), np.full((len(point), count * width), np.nan)
        W = np.linalg.inv(np.linalg.cholesky(C))
        r = (W @ r[..., None])[..., 0]
        return r[rows], (W @ J.reshape(n, count, -1))[rows]


def _direct(name: str, u: Array, places: Array) -> LineCamera:
    """A camera without distortion from readings (m,) of places (m, 3)."""
    centre = places.mean(axis=0) if len(places) else np.zeros(3)
    extent = np.linalg.svd(places - centre, compute_uv=False) if len(places) >= 3 else np.zeros(3)
    if len(places) < LEAST_PLACES:
        raise DegenerateGeometry(
            f"camera '{name}' saw {len(places)} known places: it takes {LEAST_PLACES}, spread in all directions"
        )
    if extent[2] < FLAT * extent[0]:
        raise DegenerateGeometry(
            f"camera '{name}': the known places lie in a plane (they extend {extent[2] / extent[0]:.1%} as far "
            "across as along it): add places in front of and behind it"
        )
    size, middle, spread = extent[0] / np.sqrt(len(places)), float(np.mean(u)), max(float(np.std(u)), 1e-9)
    q = np.column_stack([(places - centre) / size, np.ones(len(places))])
    v = (u - middle) / spread
    A = np.column_stack([q, -v[:, None] * q])
    weight = np.ones(len(v))
    for _ in range(30):
        h = np.linalg.svd(weight[:, None] * A, full_matrices=False)[2][-1]
        depth = q @ h[4:]
        wrong = np.abs(A @ h / np.where(depth == 0, 1e-12, depth))
        weight = 1.0 / (np.abs(depth) * np.sqrt(np.maximum(wrong, 1e-4)))
        weight /= weight.max()
    return _taken_apart(h * np.sign(np.median(depth)), centre, size, middle, spread)


def _taken_apart(h: Array, centre: Array, size: float, middle: float, spread: float) -> LineCamera:
    """Frame and lens from the eight numbers of the linear relation; the origin is level with ``centre``."""
    across, along = spread * h[:4] + middle * h[4:], h[4:]
    scale = np.linalg.norm(along[:3])
    across, along = across / scale, along / scale
    ez = along[:3]
    c = float(across[:3] @ ez)
    ex = across[:3] - c * ez
    f = float(np.linalg.norm(ex))
    ex = ex / f
    camera_R_world = np.stack([ex, np.cross(ez, ex), ez])
    shift = np.array([(across[3] - c * along[3]) / f, 0.0, along[3]]) * size
    camera_T_world = frame(camera_R_world, shift - camera_R_world @ centre)
    return LineCamera(invert(camera_T_world), f, c)

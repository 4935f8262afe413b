"""A pattern of the residuals over the image that Brown's lens leaves: tested on images that did not make it, fitted.

The residuals of half of the images give a smooth field (penalised B-splines, Eilers and Marx 1996); under the null its
product with the residuals of the other half is normal with known variance. A lens is called splined only where both
halves agree, and its splines are those of all images.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse, stats
from scipy.sparse.linalg import splu

from robcal.photogrammetry.core.camera import project
from robcal.photogrammetry.core.network import CameraNetwork
from robcal.photogrammetry.core.splined import SplinedCamera, basis, places
from robcal.transforms import Array, transform

LEVEL = 1e-5
"""Probability of calling a perfect lens splined."""
LEAST_GAIN = 0.02
"""Share of the residuals' variance that the field must explain on the other images."""
MARKS_A_NODE = 12
MOST_NODES, FEWEST_NODES = 14, 5
SMOOTHING = tuple(10.0 ** np.arange(-1.0, 4.1))
"""Weights of squared second differences of the control points, of which the images choose."""


@dataclass(frozen=True)
class LensField:
    """A field over the image.

    Attributes
    ----------
    nodes : (rows, columns, 2) px, control points. z : standard normal under the null; p_value : one-sided.
    gain : share of the variance of the residuals explained on images that did not make the field. rms : px, of the
        field at the marks.
    """

    nodes: Array
    z: float
    p_value: float
    gain: float
    rms: float

    @property
    def significant(self) -> bool:
        """Whether the lens needs it."""
        return self.p_value < LEVEL and self.gain > LEAST_GAIN


@dataclass(frozen=True)
class _Rows:
    A: sparse.csr_matrix
    r: Array
    w: Array
    half: NDArray[np.bool_]


def lens_field(network: CameraNetwork) -> LensField | None:
    """The field of a network's residuals; None where there are too few images or marks to tell.

    Notes
    -----
    Residuals of an adjustment are smaller than the errors and weakly correlated; with many marks to an unknown that
    makes the test slightly conservative.
    """
    marks, camera = network.marks, network.camera
    if len(np.unique(marks.image)) < 6:
        return None
    p = transform(network.camera_T_body[marks.image], network.points[marks.target])
    u = project(camera.brown if isinstance(camera, SplinedCamera) else camera, p)
    count = min(MOST_NODES, int(np.sqrt(len(marks) / MARKS_A_NODE * camera.width / camera.height)))
    if count < FEWEST_NODES:
        return None
    shape = (max(FEWEST_NODES, round(count * camera.height / camera.width)), count)
    residual = np.asarray(network.residuals)
    good = np.isfinite(residual).all(axis=1) & np.isfinite(u).all(axis=1)
    w = 1.0 / np.maximum(np.trace(marks.covariance, axis1=1, axis2=2) / 2.0, 1e-12)
    size = (camera.width, camera.height)
    rows = _Rows(_design(u[good], size, shape), residual[good], w[good], marks.image[good] % 2 == 0)
    variance = float(np.mean(rows.w[:, None] * rows.r**2))
    best: tuple[float, float, float] | None = None
    for smoothing in SMOOTHING:
        z, gain = _across(rows, shape, smoothing, variance)
        if best is None or gain > best[1]:
            best = (z, gain, smoothing)
    assert best is not None
    z, gain, smoothing = best
    nodes = _fit(rows, np.ones(len(rows.r), dtype=bool), shape, smoothing)
    rms = float(np.sqrt(np.mean((rows.A @ nodes) ** 2)))
    p_value = min(1.0, len(SMOOTHING) * float(stats.norm.sf(z)))
    return LensField(nodes.reshape(*shape, 2), z, p_value, gain, rms)


def with_field(network: CameraNetwork, field: LensField) -> SplinedCamera:
    """The network's camera with the field added to what splines it has."""
    c = network.camera
    nodes = field.nodes
    if isinstance(c, SplinedCamera):
        if c.nodes.shape != nodes.shape:
            return c
        nodes = c.nodes + nodes
    return replace(SplinedCamera(c.width, c.height, *c.vector.tolist()), nodes=nodes)


def _across(rows: _Rows, shape: tuple[int, int], smoothing: float, variance: float) -> tuple[float, float]:
    """Normal number of the agreement of both halves of the images, and the share of variance explained across them."""
    z, before, after = 0.0, 0.0, 0.0
    for half in (rows.half, ~rows.half):
        predicted = rows.A[~half] @ _fit(rows, half, shape, smoothing)
        r, w = rows.r[~half], rows.w[~half, None]
        size = float(np.sum(w * predicted**2))
        z += float(np.sum(w * predicted * r)) / np.sqrt(max(variance * size, 1e-300))
        before += float(np.sum(w * r**2))
        after += float(np.sum(w * (r - predicted) ** 2))
    return z / np.sqrt(2.0), 1.0 - after / max(before, 1e-300)


def _fit(rows: _Rows, chosen: NDArray[np.bool_], shape: tuple[int, int], smoothing: float) -> Array:
    """Control points (n, 2) from the chosen rows."""
    A, w = rows.A[chosen], sparse.diags(rows.w[chosen] / rows.w.mean())
    N = (A.T @ w @ A + smoothing * _roughness(shape)).tocsc()
    return np.asarray(splu(N + 1e-9 * sparse.identity(N.shape[0], format="csc")).solve(A.T @ w @ rows.r[chosen]))


def _roughness(shape: tuple[int, int]) -> sparse.csr_matrix:
    """Sum of squared second differences along both directions."""
    D = [sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(n - 2, n)) for n in shape]
    E = [sparse.identity(n) for n in shape]
    across, along = sparse.kron(D[0], E[1]), sparse.kron(E[0], D[1])
    return sparse.csr_matrix(across.T @ across + along.T @ along)


def _design(u: Array, size: tuple[int, int], shape: tuple[int, int]) -> sparse.csr_matrix:
    """Weights (m, n) of all control points at pixels (m, 2)."""
    first, t, _, _ = places(u, size, shape)
    wx, wy = basis(t[:, 0])[0], basis(t[:, 1])[0]
    at = np.arange(4)
    columns = (first[:, 1, None] + at)[:, :, None] * shape[1] + (first[:, 0, None] + at)[:, None, :]
    weights = wy[:, :, None] * wx[:, None, :]
    m = len(u)
    rows = np.repeat(np.arange(m), 16)
    return sparse.csr_matrix((weights.ravel(), (rows, columns.ravel())), shape=(m, shape[0] * shape[1]))

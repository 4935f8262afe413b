"""A finished network as a linear operator: what its unknowns absorb, for tests of effects the model leaves out."""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from robcal.errors import InvalidInput
from robcal.photogrammetry.bundle.covariance import factorise
from robcal.photogrammetry.bundle.datum import Datum
from robcal.photogrammetry.bundle.determinacy import intrinsics_basis
from robcal.photogrammetry.bundle.lengths import rows_of
from robcal.photogrammetry.bundle.normals import MarkOrder, State
from robcal.photogrammetry.bundle.solver import Bars, Problem
from robcal.photogrammetry.core.network import CameraNetwork, Lengths
from robcal.transforms import Array


def problem_of(network: CameraNetwork, lengths: Lengths | None = None) -> tuple[Problem, State]:
    """The adjustment problem and state of a finished network, weights as estimated, with scale bars if given."""
    bars = lengths or Lengths.none()
    marks = network.marks
    order = MarkOrder(marks, len(network.image_names), len(network.ids))
    everything = np.arange(len(network.ids), dtype=np.int64)
    held = np.all(np.diag(network.points_covariance).reshape(-1, 3) == 0.0, axis=1)
    if held.any():
        datum = Datum("fixed", np.flatnonzero(held), False, network.datum)
    else:
        datum = Datum("inner", everything, len(bars) == 0, network.datum)
    problem = Problem(
        order,
        intrinsics_basis(network.free_intrinsics),
        datum,
        Bars(rows_of(bars, network.ids), bars.length, bars.sigma * network.bars_sigma0),
        network.radii,
        network.normals,
        np.zeros(len(marks), np.int64) if order.marks.group is None else order.marks.group,
        network.group_sigma0,
    )
    return problem, State(network.camera, network.camera_T_body, network.points)


@dataclass(frozen=True)
class EffectTest:
    """Test of extra columns: estimate (q,), covariance (q, q), chi-square, its p-value."""

    estimate: Array
    covariance: Array
    chi2: float
    p_value: float


class NetworkOperator:
    """Whitened residuals and the projection that the network's own unknowns cannot absorb.

    Marks are in the order of ``network.marks``; rows of whitened vectors are x and y of each mark, (2m,).
    """

    def __init__(self, network: CameraNetwork, lengths: Lengths | None = None) -> None:
        self.network = network
        problem, state = problem_of(network, lengths)
        self.problem, self.state = problem, state
        self.lin, self.factor = factorise(problem, state)
        self.root = np.sqrt(problem.weights)
        self.J = self.lin.J * self.root[:, None, None]

    @property
    def residuals(self) -> Array:
        """(2m,) whitened residuals."""
        return (self.lin.r * self.root[:, None]).ravel()

    def whiten(self, columns: Array) -> Array:
        """Whitened (2m, q) of image displacements (m, 2) or (m, 2, q) in px."""
        d = np.asarray(columns, dtype=float)
        if d.shape[:2] != (len(self.network.marks), 2):
            raise InvalidInput(f"columns need shape ({len(self.network.marks)}, 2, q), got {d.shape}")
        d = d.reshape(*d.shape[:2], -1)
        return (np.einsum("mij,mjq->miq", self.problem.order.whitener, d) * self.root[:, None, None]).reshape(
            -1, d.shape[2]
        )

    def project_out(self, whitened: Array) -> Array:
        """What remains of whitened columns (2m, q) after the network's unknowns have absorbed what they can."""
        order, k = self.problem.order, self.lin.k
        c = np.asarray(whitened, dtype=float).reshape(len(order.marks), 2, -1)
        q = c.shape[2]
        b = np.zeros((self.factor.a, q))
        b[:k] = np.einsum("mik,miq->kq", self.J[:, :, :k], c)
        on_points = np.einsum("mip,miq->mpq", self.J[:, :, k : k + 3], c)
        on_stations = np.einsum("mip,miq->mpq", self.J[:, :, k + 3 :], c)
        points = np.zeros((order.targets, 3, q))
        np.add.at(points, order.marks.target, on_points)
        b[k:] = points.reshape(-1, q)
        s = np.zeros((order.images, 6, q))
        np.add.at(s, order.marks.image, on_stations)
        x, z = self.factor.solve(b, s)
        absorbed = np.einsum("mik,kq->miq", self.J[:, :, :k], x[:k])
        absorbed += np.einsum("mip,mpq->miq", self.J[:, :, k : k + 3], x[k:].reshape(-1, 3, q)[order.marks.target])
        absorbed += np.einsum("mip,mpq->miq", self.J[:, :, k + 3 :], z[order.marks.image])
        return (c - absorbed).reshape(-1, q)

    def test(self, columns: Array) -> EffectTest:
        """Estimate and significance of an effect with image displacements (m, 2, q) px per unit parameter."""
        P = self.project_out(self.whiten(columns))
        A = P.T @ P
        scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-300))
        inverse = np.linalg.pinv(A * scale[:, None] * scale[None, :], rcond=1e-10, hermitian=True)
        inverse *= scale[:, None] * scale[None, :]
        b = P.T @ self.residuals
        estimate = inverse @ b
        chi2 = float(b @ estimate)
        return EffectTest(estimate, np.asarray(inverse, dtype=float), chi2, float(stats.chi2.sf(chi2, P.shape[1])))

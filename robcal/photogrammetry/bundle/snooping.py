"""Reliability of a network's marks: redundancy numbers (Baarda 1968)."""

from dataclasses import dataclass

import numpy as np

from robcal.estimation.schur import Factor
from robcal.photogrammetry.bundle.normals import Linearised, MarkOrder
from robcal.transforms import Array


@dataclass(frozen=True)
class Reliability:
    """Per mark, sorted as in the MarkOrder.

    ``residual_cofactor`` (m, 2, 2) of the whitened residuals; ``share`` (m,) its trace, the mark's redundancy.
    """

    residual_cofactor: Array

    @property
    def share(self) -> Array:
        """Redundancy (m,) of each mark, 0 .. 2."""
        return np.trace(self.residual_cofactor, axis1=1, axis2=2)


def reliability(lin: Linearised, order: MarkOrder, factor: Factor, Q: Array, weights: Array) -> Reliability:
    """Cofactors of the whitened residuals ``I - J Q J'`` from the marginal cofactors of each mark's unknowns.

    ``weights`` (m,) are those of the normal equations; the result is for marks whitened with them.
    """
    k, marks = lin.k, order.marks
    t = order.targets
    Q_station, Q_mixed = factor.station_cofactors(Q)
    J = lin.J * np.sqrt(weights)[:, None, None]
    Jc, Jx, Jp = J[:, :, :k], J[:, :, k : k + 3], J[:, :, k + 3 :]
    Qx = Q[k:, k:].reshape(t, 3, t, 3)[np.arange(t), :, np.arange(t), :]
    Qxc = Q[k:, :k].reshape(t, 3, k)
    Qxp = Q_mixed[k:].reshape(t, 3, order.images, 6)
    Qcp = Q_mixed[:k].transpose(1, 0, 2)
    # half of the mixed terms plus half of the pure ones, then the transpose is added
    by_camera = 0.5 * (Jc @ Q[:k, :k]) + Jx @ Qxc[marks.target]
    by_point = 0.5 * (Jx @ Qx[marks.target])
    by_station = 0.5 * (Jp @ Q_station[marks.image]) + Jc @ Qcp[marks.image] + Jx @ Qxp[marks.target, :, marks.image, :]
    half = np.einsum("mia,mja->mij", by_camera, Jc)
    half += np.einsum("mia,mja->mij", by_point, Jx)
    half += np.einsum("mia,mja->mij", by_station, Jp)
    return Reliability(np.eye(2) - half - np.swapaxes(half, 1, 2))

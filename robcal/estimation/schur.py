"""Reduced normal equations: unknowns that only their own rows see are eliminated (Schur complement).

Sources: Brown (1976), "The bundle adjustment - progress and prospects"; Triggs, McLauchlan, Hartley, Fitzgibbon (2000),
"Bundle adjustment: a modern synthesis", section 6; inner constraints after Granshaw (1980), Photogrammetric Record
10(56):181-207.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from robcal.estimation.grouping import Array


@dataclass(frozen=True)
class Normals:
    """Normal equations of shared unknowns and of n stations (or poses) of six unknowns each.

    ``A`` (a, a) of the shared unknowns, ``G`` (n, a, 6) mixed, ``V`` (n, 6, 6) of the stations; right-hand sides ``b``
    (a,) and ``s`` (n, 6).
    """

    A: Array
    G: Array
    V: Array
    b: Array
    s: Array


class SingularSystem(np.linalg.LinAlgError):
    """The reduced system is singular; ``weakest`` (a,) is its least determined direction, unknowns equilibrated."""

    def __init__(self, S: Array, free: NDArray[np.intp], a: int) -> None:
        super().__init__("singular normal equations")
        scale = np.sqrt(np.maximum(np.diag(S), 1e-300))
        self.weakest = np.zeros(a)
        self.weakest[free] = np.linalg.eigh(S / np.outer(scale, scale))[1][:, 0]


class Factor:
    """Cholesky factors of the normal equations with the stations eliminated.

    Parameters
    ----------
    constraints : (c, d) orthonormal inner constraints on the last c shared unknowns, d may be 0; None: none.
    held : (a,) true for unknowns of the reduced system that are held fixed; None: none.
    damping : Levenberg factor on the diagonal (0: plain Gauss-Newton).

    Unknowns of a station on which no row depends keep their value.

    Raises
    ------
    SingularSystem : the reduced system is singular. numpy.linalg.LinAlgError : a station's own equations are.
    """

    def __init__(
        self,
        normals: Normals,
        constraints: Array | None = None,
        held: NDArray[np.bool_] | None = None,
        damping: float = 0.0,
    ) -> None:
        A, G, V = normals.A, normals.G, normals.V
        n, a = len(V), len(A)
        constraints = np.zeros((a, 0)) if constraints is None else constraints
        self.first = a - len(constraints)
        diagonal = np.diagonal(V, axis1=1, axis2=2)
        if damping > 0:
            V = V + damping * np.eye(6) * diagonal[:, :, None]
        # equilibrate: positions in m and angles in rad differ by orders of magnitude for far or near cameras
        unseen = diagonal <= 0.0
        scale = np.where(unseen, 0.0, 1.0 / np.sqrt(np.where(unseen, 1.0, diagonal)))
        L = np.linalg.cholesky(V * scale[:, :, None] * scale[:, None, :] + np.eye(6) * unseen[:, :, None])
        self.station_root = np.linalg.inv(L) * scale[:, None, :]  # V^-1 = root' root
        self.Y = np.ascontiguousarray(
            np.matmul(G, np.swapaxes(self.station_root, 1, 2)).transpose(1, 0, 2).reshape(a, 6 * n)
        )
        S = A - self.Y @ self.Y.T
        if damping > 0:
            S[np.diag_indices(a)] += damping * np.diag(A)
        free = np.arange(a) if held is None else np.flatnonzero(~held)
        S = S[np.ix_(free, free)]
        self.scale = 1.0 / np.sqrt(np.maximum(np.diag(A)[free], 1e-300))
        S *= self.scale[:, None] * self.scale[None, :]
        self.equilibrated = S
        B = np.zeros((a, constraints.shape[1]))
        B[self.first :] = constraints
        self.constraints = B[free] * self.scale[:, None]
        if constraints.shape[1]:
            self.constraints /= np.max(np.abs(self.constraints))
            S = S + self.constraints @ self.constraints.T
        self.free, self.a = free, a
        try:
            self.cholesky = linalg.cho_factor(S, lower=True, overwrite_a=False, check_finite=False)
        except linalg.LinAlgError:
            raise SingularSystem(S, free, a) from None

    @property
    def station_inverse(self) -> Array:
        """(n, 6, 6) inverses of the stations' own normal matrices, zero where no row depends on an unknown."""
        return np.matmul(np.swapaxes(self.station_root, 1, 2), self.station_root)

    @property
    def station_response(self) -> Array:
        """(n, 6, a) derivatives of the stations by the shared unknowns: ``-V^-1 G'``."""
        Y = self.Y.reshape(self.a, len(self.station_root), 6).transpose(1, 2, 0)
        return -np.matmul(np.swapaxes(self.station_root, 1, 2), Y)

    def solve(self, b: Array, s: Array) -> tuple[Array, Array]:
        """Steps of the shared unknowns (a, ...) and the stations (n, 6, ...) for right-hand sides of these shapes."""
        n = len(s)
        rest = b.shape[1:]
        z = np.einsum("nij,nj...->ni...", self.station_root, s)
        reduced = b - np.tensordot(self.Y, z.reshape((6 * n, *rest)), axes=1)
        x = np.zeros((self.a, *rest))
        scale = self.scale.reshape((-1,) + (1,) * len(rest))
        x[self.free] = scale * linalg.cho_solve(self.cholesky, scale * reduced[self.free], check_finite=False)
        back = z - np.tensordot(self.Y.T, x, axes=1).reshape((n, 6, *rest))
        return x, np.einsum("nji,nj...->ni...", self.station_root, back)

    def cofactors(self, null_space: Array | None = None) -> Array:
        """Cofactor matrix (a, a) of the shared unknowns, zero where held, in the datum of the constraints if any.

        With null space N and constraints B: ``Q = (S + B B')^-1 - N (N' B B' N)^-1 N'``.
        """
        inverse, info = linalg.lapack.dpotri(self.cholesky[0], lower=1)
        if info != 0:
            raise np.linalg.LinAlgError("singular normal equations")
        inverse = np.tril(inverse) + np.tril(inverse, -1).T
        if null_space is not None and self.constraints.shape[1]:
            N = np.zeros((self.a, null_space.shape[1]))
            N[self.first :] = null_space
            N = N[self.free] / self.scale[:, None]
            BN = self.constraints.T @ N
            inverse -= N @ np.linalg.solve(BN.T @ BN, N.T)
        inverse *= self.scale[:, None] * self.scale[None, :]
        Q = np.zeros((self.a, self.a))
        Q[np.ix_(self.free, self.free)] = inverse
        return Q

    def station_cofactors(self, Q: Array) -> tuple[Array, Array]:
        """Cofactors of the stations (n, 6, 6) and mixed ones (a, n, 6) of shared unknowns and stations."""
        return station_cofactors(self.station_inverse, self.station_response, Q)


def station_cofactors(inverse: Array, response: Array, Q: Array) -> tuple[Array, Array]:
    """Cofactors of the stations (n, 6, 6) and mixed ones (a, n, 6) of shared unknowns and stations.

    ``inverse`` (n, 6, 6) and ``response`` (n, 6, a) as :class:`Factor` has them, ``Q`` (a, a) of the shared unknowns.
    """
    n, _, a = response.shape
    mixed = (Q @ np.ascontiguousarray(response.reshape(6 * n, a)).T).reshape(a, n, 6)
    return inverse + np.matmul(response, mixed.transpose(1, 0, 2)), mixed

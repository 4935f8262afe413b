"""An oriented station as a linear problem: marks and weighted observations of unknowns, and what they absorb.

The adjustment takes the body's coordinates and the start values of the lens as observations. Only with their rows is
"what the unknowns absorb" an orthogonal projection, and only then a displaced target shows in the right size.
"""

from collections.abc import Mapping

import numpy as np
from scipy import linalg, sparse, stats

from robcal.diagnosis.images.diagnosis import spread_of_others
from robcal.diagnosis.scan.statistics import orthonormal_basis
from robcal.estimation.grouping import sum_by
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.station.adjustment import global_columns, interior_basis, interior_prior
from robcal.photogrammetry.station.assembly import body_weight
from robcal.photogrammetry.station.contradictions import CAMERA_MOVED
from robcal.photogrammetry.station.network import StationDesign, StationOrientation, StationSettings, Unknowns
from robcal.photogrammetry.station.scan import scan_moves
from robcal.photogrammetry.station.start import exchanged
from robcal.physics.cause import Array
from robcal.physics.images.data import LENS_TERMS, ImageData
from robcal.transforms import invert, transform

FROM_FILE = 0.1
"""Start values from a camera file are weighted ten times tighter than those of an unknown lens (station_state)."""
RELEASED = 1.0
"""Standard deviation (m) of a target whose stated coordinates are not used."""
LEAST_INFLATION = 1.5
"""Factor of the body's variance from which its stated accuracy counts as too optimistic."""


class StationOperator:
    """Projection of whitened rows (marks, then extra observations) beside all unknowns of a station.

    Parameters
    ----------
    columns : (m, 18) global columns of each mark. extra : (k, g) whitened rows of the weighted observations.
    """

    def __init__(self, design: StationDesign, pose: Array, columns: Array, extra: sparse.csr_matrix) -> None:
        m, g, p = len(pose), len(design.active), len(design.pose_inverse)
        blocks = np.concatenate([design.by_exterior, design.by_interior, design.by_point], axis=2)
        marks = sparse.csr_matrix(
            (blocks.ravel(), np.repeat(columns, 2, axis=0).ravel(), np.arange(0, 36 * m + 1, 18)), shape=(2 * m, g)
        )
        at = np.repeat(6 * pose[:, None] + np.arange(6), 2, axis=0)
        rows = sparse.csr_matrix((design.by_pose.ravel(), at.ravel(), np.arange(0, 12 * m + 1, 6)), (2 * m, 6 * p))
        self.A = sparse.vstack([marks, extra], format="csr")[:, np.flatnonzero(design.active)]
        self.B = sparse.vstack([rows, sparse.csr_matrix((extra.shape[0], 6 * p))], format="csr")
        V = sum_by(pose, np.swapaxes(design.by_pose, 1, 2) @ design.by_pose, p)
        size = np.sqrt(np.maximum(np.einsum("pii->pi", V), 1e-300))
        outer = size[:, :, None] * size[:, None, :]
        seen = V.diagonal(axis1=1, axis2=2).min(axis=1) > 0
        self.V = np.zeros_like(V)
        self.V[seen] = np.linalg.pinv(V[seen] / outer[seen], rcond=1e-12, hermitian=True) / outer[seen]
        self.W = np.asarray((self.A.T @ self.B).toarray())
        reduced = (self.A.T @ self.A).toarray() - self.W @ self._poses(self.W.T)
        unit = 1.0 / np.sqrt(np.maximum(np.diag(reduced), 1e-300))
        values, vectors = linalg.eigh(reduced * np.outer(unit, unit))
        good = values > 1e-12 * values[-1]
        self.root = unit[:, None] * vectors[:, good] / np.sqrt(values[good])
        self.freedom = int(self.A.shape[0] - good.sum() - 6 * seen.sum())

    def _poses(self, v: Array) -> Array:
        return np.asarray(np.einsum("pij,pjq->piq", self.V, v.reshape(len(self.V), 6, -1)).reshape(v.shape))

    def remove(self, columns: Array) -> Array:
        """Rows (r, q) or (r,) without what the unknowns absorb."""
        c = columns.reshape(len(columns), -1)
        alone = self._poses(np.asarray(self.B.T @ c))
        x = self.root @ (self.root.T @ (self.A.T @ c - self.W @ alone))
        z = alone - self._poses(self.W.T @ x)
        return np.asarray(c - self.A @ x - self.B @ z).reshape(columns.shape)


def station_data(
    orientation: StationOrientation,
    pose_names: tuple[str, ...],
    given: Body | None = None,
    start: Mapping[str, Camera | None] | None = None,
    covariates: Mapping[str, Array] | None = None,
) -> ImageData:
    """The images of an oriented station.

    Parameters
    ----------
    pose_names : names of all poses. given : the body as it was given to the adjustment; None: its coordinates count as
        free. start : camera -> its file's interior orientation. covariates : per pose number, `hours` or
        `temp_<place>_c`; poses with NaN count as unchanged.
    """
    marks, design = orientation.marks, orientation.design
    e, c = len(orientation.world_T_exterior), len(orientation.names)
    columns = global_columns(marks, e, c)
    camera_T_world = invert(orientation.world_T_exterior)[marks.exterior]
    T = camera_T_world @ orientation.world_T_body[marks.pose]
    unwhite = np.linalg.inv(design.whitening)
    operator, residual = _projected(orientation, columns, given, start or {})

    def whiten(displacement: Array) -> Array:
        rows = (design.whitening @ displacement).reshape(2 * len(marks), -1)
        return np.concatenate([rows, np.zeros((operator.A.shape[0] - len(rows), rows.shape[1]))])

    single = scan_moves(design, marks, c, len(orientation.poses), columns).single
    scatter = float(np.median(single[single > 0]) / stats.chi2.median(6)) if np.any(single > 0) else 1.0
    normals = np.where(np.isfinite(marks.normals), marks.normals, np.nan)
    carried = orientation.body
    centre = carried.points[np.unique(marks.target)].mean(axis=0)
    return ImageData(
        names=orientation.names,
        cameras=orientation.cameras,
        camera=marks.camera,
        image=marks.pose,
        target=carried.ids[marks.target],
        p_camera=transform(T, carried.points[marks.target]),
        camera_R_body=T[:, :3, :3],
        normal_camera=np.einsum("mij,mj->mi", T[:, :3, :3], normals),
        xy=marks.xy,
        residual=residual,
        redundancy=orientation.redundancy,
        freedom=operator.freedom,
        whiten=whiten,
        remove=operator.remove,
        by_exterior=unwhite @ design.by_exterior,
        by_target=None if given is None else unwhite @ design.by_point,
        p_body=carried.points[marks.target] - centre,
        body=carried.name,
        free=_free(orientation, start or {}),
        radii=np.nan_to_num(marks.radius),
        sigma_px=float(1.0 / np.sqrt(np.mean(design.whitening**2) * 2.0)),
        image_names=tuple(pose_names[int(p)] for p in orientation.poses),
        dots=not all(code == "corner" for code in carried.codes),
        covariates={
            name: np.nan_to_num(np.asarray(values)[orientation.poses] - values[orientation.poses[0]])[marks.pose]
            for name, values in (covariates or {}).items()
        },
        inflation={CAMERA_MOVED.name: max(1.0, scatter)},
    )


def _projected(
    orientation: StationOrientation, columns: Array, given: Body | None, start: Mapping[str, Camera | None]
) -> tuple[StationOperator, Array]:
    """The operator with rows of the lens and the body, and the residuals that it leaves."""
    design = orientation.design
    lens = _lens_rows(orientation, start)
    factor = 1.0
    while True:
        rows = (lens, _body_rows(orientation, given, factor))
        extra = sparse.vstack([sparse.csr_matrix(J * design.active.astype(float)) for J, _ in rows], format="csr")
        operator = StationOperator(design, orientation.marks.pose, columns, extra)
        residual = operator.remove(np.concatenate([design.residual.ravel(), *(r for _, r in rows)]))
        if given is None or factor > 1.0:
            return operator, residual
        # a body less accurate than stated gets the weight that it deserves
        factor = _target_spread(orientation, operator, residual)
        if factor < LEAST_INFLATION:
            return operator, residual


def given_points(orientation: StationOrientation, given: Body) -> Body:
    """The body as the adjustment took it: with targets exchanged where it found them swapped."""
    for item in orientation.evidence:
        if item.kind.is_relabelling:
            i, j = (int(given.index([int(part)])[0]) for part in (item.where, item.partner))
            given = exchanged(given, i, j)
    return given


def _body_rows(orientation: StationOrientation, given: Body | None, factor: float) -> tuple[Array, Array]:
    """Whitened rows (3t, g) and residuals of the stated coordinates, their variance times `factor`."""
    g = len(orientation.design.active)
    if given is None:
        return np.zeros((0, g)), np.zeros(0)
    stated = given_points(orientation, given)
    t = len(stated)
    x = Unknowns(np.zeros((0, 9)), orientation.world_T_exterior, orientation.world_T_body, orientation.body.points)
    weight = body_weight(stated, orientation.marks, x, orientation.cameras, StationSettings()) / factor
    released = [item.where for item in orientation.evidence if item.kind.moves == "target"]
    if released:
        C = np.asarray(np.linalg.inv(weight))
        for name in released:
            at = 3 * int(stated.index([int(name)])[0]) + np.arange(3)
            C[at, :] = C[:, at] = 0.0
            C[at, at] = RELEASED**2
        weight = np.asarray(np.linalg.inv(C))
    root = np.linalg.cholesky(0.5 * (weight + weight.T)).T
    J = np.zeros((3 * t, g))
    J[:, g - 3 * t :] = root
    miss = np.where(np.isfinite(stated.points), stated.points - orientation.body.points, 0.0)
    return J, root @ np.nan_to_num(miss).ravel()


def _lens_rows(orientation: StationOrientation, start: Mapping[str, Camera | None]) -> tuple[Array, Array]:
    """Whitened rows (9c, g) and residuals of the start values of the interior orientation."""
    e, c, g = len(orientation.world_T_exterior), len(orientation.names), len(orientation.design.active)
    J, r = np.zeros((9 * c, g)), np.zeros(9 * c)
    for i, (name, camera) in enumerate(zip(orientation.names, orientation.cameras, strict=True)):
        file = start.get(name)
        sigma = interior_prior(camera if file is None else file) * (1.0 if file is None else FROM_FILE)
        J[9 * i + np.arange(9), 6 * e + 9 * i + np.arange(9)] = 1.0 / sigma
        offset = camera.vector - np.r_[camera.vector[:4], np.zeros(5)]
        if file is not None:
            offset = np.linalg.solve(interior_basis(file.vector[None])[0], camera.vector - file.vector)
        r[9 * i : 9 * i + 9] = -offset / sigma
    return J, r * orientation.design.active[6 * e : 6 * e + 9 * c]


def _target_spread(orientation: StationOrientation, operator: StationOperator, residual: Array) -> float:
    """How far the targets scatter about their stated coordinates, the worst set aside: one for a right body."""
    marks, design = orientation.marks, orientation.design
    seen = np.unique(marks.target)
    bases: list[Array] = []
    for some in np.array_split(seen, max(1, len(seen) // 64)):
        shift = np.zeros((operator.A.shape[0], 3 * len(some)))
        for k, target in enumerate(some):
            rows = np.flatnonzero(marks.target == target)
            both = (2 * rows[:, None] + np.arange(2)).ravel()
            shift[both, 3 * k : 3 * k + 3] = design.by_point[rows].reshape(-1, 3)
        P = operator.remove(shift).reshape(-1, len(some), 3)
        bases += [orthonormal_basis(P[:, k]) for k in range(len(some))]
    return spread_of_others([basis for basis in bases if basis.shape[1]], residual)


def _free(orientation: StationOrientation, start: Mapping[str, Camera | None]) -> tuple[frozenset[str], ...]:
    groups = {"focal": ("fx", "fy", "f_only"), "principal": ("cx", "cy"), "tangential": ("p1", "p2")}
    return tuple(
        frozenset(part for g in orientation.free_interior.get(name, ()) for part in groups.get(g, (g,)))
        | (frozenset() if start.get(name) is not None else LENS_TERMS)
        for name in orientation.names
    )

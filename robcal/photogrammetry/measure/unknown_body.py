"""The method with unknown targets: coordinates of a body from the measured points themselves.

Three targets define a frame by Gram-Schmidt orthogonalisation (Golub and Van Loan 2013, Matrix Computations, section
5.2), origin in the first, x axis to the second, the third in the x-y plane. With more poses the mean triangle is used
instead of each single one, which is the same frame with less noise; further targets are added in that frame.
"""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from robcal.errors import DegenerateGeometry
from robcal.photogrammetry.core.bodies import Body, IntArray, spans_plane
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.transforms import Array, fit_frame, gram_schmidt_frame, invert, transform


def body_from_points(points: MeasuredPoints, use: NDArray[np.bool_], ids: IntArray | None = None) -> Body:
    """Body of the measured targets in the Gram-Schmidt frame of its best triangle.

    The triangle: of those seen together most often, the one of the largest area; its targets in the order of the body.

    Parameters
    ----------
    use : (m,) points to use; ids : order (and choice) of targets, default all measured, ascending.

    Raises
    ------
    DegenerateGeometry : no three targets are measured together, or all in one line.
    """
    wanted = np.unique(points.target[use]) if ids is None or len(ids) == 0 else np.asarray(ids)
    rows = np.flatnonzero(use & np.isin(points.target, wanted))
    poses = np.unique(points.pose[rows])
    at = {int(i): k for k, i in enumerate(wanted)}
    p = np.full((len(poses), len(wanted), 3), np.nan)
    for i in rows:
        p[np.searchsorted(poses, points.pose[i]), at[int(points.target[i])]] = points.p_world[i]
    seen = np.isfinite(p).all(axis=2)
    triangle = _triangle(p, seen)
    with_it = np.flatnonzero(seen[:, triangle].all(axis=1))
    local = np.stack([transform(invert(gram_schmidt_frame(p[k, triangle])), p[k]) for k in with_it])
    shape = np.full((len(wanted), 3), np.nan)
    measured = np.isfinite(local).all(axis=2).any(axis=0)
    shape[measured] = np.nanmedian(local[:, measured], axis=0)
    # further rounds: every pose that shares three targets with the shape helps, and brings its other targets
    for _ in range(4):
        moved = []
        for k in range(len(poses)):
            both = seen[k] & np.isfinite(shape).all(axis=1)
            if spans_plane(shape[both]):
                moved.append(transform(invert(fit_frame(p[k, both], shape[both])), p[k]))
        stack = np.array(moved)
        known = np.isfinite(stack).all(axis=2).any(axis=0)
        shape[known] = np.nanmedian(stack[:, known], axis=0)
        shape = transform(invert(gram_schmidt_frame(shape[triangle])), shape)
    return Body("unknown", np.array(wanted, dtype=np.int64), shape)


def _triangle(p: Array, seen: NDArray[np.bool_]) -> list[int]:
    best: tuple[tuple[int, float], list[int]] | None = None
    t = p.shape[1]
    order = np.argsort(-seen.sum(axis=0), kind="stable")[:12]
    for chosen in combinations(sorted(int(i) for i in order), 3):
        rows = seen[:, list(chosen)].all(axis=1)
        if not rows.any():
            continue
        q = p[rows][:, list(chosen)]
        if not spans_plane(q[0]):
            continue
        area = float(np.median(np.linalg.norm(np.cross(q[:, 1] - q[:, 0], q[:, 2] - q[:, 0]), axis=1)))
        key = (int(rows.sum()), area)
        if best is None or key > best[0]:
            best = (key, list(chosen))
    if best is None:
        raise DegenerateGeometry(
            f"a body without coordinates needs three targets measured together and not in one line ({t} are measured)"
        )
    return best[1]

"""Start values of camera and board from poses of the board in single images, in closed form.

``A_i X = Z B_i`` with ``B_i`` the camera seen from the board. Rotations by the Kronecker product (Shah 2013, "Solving
the robot-world/hand-eye calibration problem using the Kronecker product"), which has no singular angle (half turns are
as good as any other) and no pairs of poses to choose; then translations by linear least squares. Single images may be
wrong (labels, a board that moved, the second pose of a plane), so many small samples are solved as well and all are
judged in the images (Fischler and Bolles 1981).
"""

from dataclasses import dataclass

import numpy as np

from robcal.handeye.data import BoolArray, HandEyeData
from robcal.photogrammetry.core.bodies import IntArray
from robcal.photogrammetry.core.camera import Camera, project
from robcal.transforms import Array, frame, invert, transform

SAMPLES = 240
MARKS = 12
SAMPLE = 4
"""Images in a sample: three carry the unknowns, one more makes their choice stable."""


@dataclass(frozen=True)
class Start:
    """Camera and board in their carriers, and the root mean square distance (n,) px of marks in each image."""

    X: Array
    Z: Array
    image_px: Array

    @property
    def score(self) -> float:
        """Sum of logarithms of the images' errors: most images decide, however far the others are off."""
        return float(np.sum(np.log(self.image_px**2 + 0.05**2)))


def solve_many(A: Array, B: Array) -> tuple[Array, Array]:
    """``X, Z`` (k, 4, 4) of k sets of equations ``A_i X = Z B_i``, each (k, s, 4, 4), s >= 3."""
    RA, RB = A[..., :3, :3], B[..., :3, :3]
    K = np.einsum("ksab,kscd->kacbd", RB, RA).reshape(len(A), 9, 9)
    U, _, Vt = np.linalg.svd(K)
    # vec of both rotations in the first pair of singular vectors, row by row of the transposed rotation
    RX = _rotation(np.swapaxes(Vt[:, 0].reshape(-1, 3, 3), 1, 2))
    RZ = _rotation(np.swapaxes(U[:, :, 0].reshape(-1, 3, 3), 1, 2))
    s = A.shape[1]
    rows = np.concatenate([RA, np.broadcast_to(-np.eye(3), RA.shape)], axis=-1).reshape(len(A), 3 * s, 6)
    right = (np.einsum("kij,ksj->ksi", RZ, B[..., :3, 3]) - A[..., :3, 3]).reshape(len(A), 3 * s, 1)
    t = (np.linalg.pinv(rows, rcond=1e-9) @ right)[..., 0]
    return frame(RX, t[:, :3]), frame(RZ, t[:, 3:])


def _rotation(M: Array) -> Array:
    """Nearest rotations (k, 3, 3) of matrices known up to a factor of either sign."""
    sign = np.where(np.linalg.det(M) < 0, -1.0, 1.0)[:, None, None]
    U, _, Vt = np.linalg.svd(sign * M)
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    return U @ Vt


def image_errors(data: HandEyeData, camera: Camera, X: Array, Z: Array) -> Array:
    """Root mean square distance (k, n) px of the marks of each image from where k starts put them."""
    A = data.carriers()
    views = invert(X)[:, None] @ invert(A)[None] @ Z[:, None]
    off = project(camera, transform(views[:, data.image], data.points)) - data.xy
    far = float(max(camera.width, camera.height))
    square = np.where(np.isfinite(off).all(axis=-1), np.minimum(np.sum(off**2, axis=-1), far**2), far**2)
    count = np.maximum(np.bincount(data.image, minlength=data.n), 1)
    sums = np.stack([np.bincount(data.image, weights=row, minlength=data.n) for row in square])
    return np.sqrt(sums / count)


def start_values(data: HandEyeData, camera: Camera, camera_T_board: Array, other: Array, seed: int = 1) -> Start:
    """The start that puts most images right.

    Parameters
    ----------
    camera_T_board, other : (n, 4, 4) from single images and the second pose of a plane, NaN where there is none.
    """
    views = np.concatenate([camera_T_board, other])
    usable = np.flatnonzero(np.isfinite(views).all(axis=(1, 2)))
    image = usable % data.n
    A, B = data.carriers()[image], invert(views[usable])
    data = _few_marks(data)
    rng = np.random.default_rng(seed)
    size = min(SAMPLE, len(usable))
    picks = np.array([rng.choice(len(usable), size, replace=False) for _ in range(SAMPLES)])
    X, Z = solve_many(A[picks], B[picks])
    first = usable < data.n
    every = solve_many(A[None, first], B[None, first])
    X, Z = np.concatenate([every[0], X]), np.concatenate([every[1], Z])
    errors = image_errors(data, camera, X, Z)
    seen = np.bincount(data.image, minlength=data.n) > 0
    starts = sorted((Start(*each) for each in zip(X, Z, errors, strict=True)), key=lambda s: _score(s, seen))[:5]
    return min((_settled(data, camera, image, A, B, start) for start in starts), key=lambda s: _score(s, seen))


def _score(start: Start, seen: BoolArray) -> float:
    return Start(start.X, start.Z, start.image_px[seen]).score


def _few_marks(data: HandEyeData) -> HandEyeData:
    """About a dozen marks of each image: enough to judge a start."""
    count = np.bincount(data.image, minlength=data.n)
    step = np.maximum(count // MARKS, 1)[data.image]
    order = np.argsort(data.image, kind="stable")
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    return data.marks(rank % step == 0)


def _settled(data: HandEyeData, camera: Camera, image: IntArray, A: Array, B: Array, start: Start) -> Start:
    """A start solved again from the images that agree with it, as long as more of them do."""
    best = start
    for _ in range(6):
        own = best.image_px[image]
        # of two poses of a plane in one image, the one nearer to where the start sees the board
        views = best.X @ invert(B) @ invert(best.Z)  # inverse carrier as this pose of the board would have it
        turn = np.einsum("kij,kji->k", A[:, :3, :3], views[:, :3, :3])
        best_turn = np.full(data.n, -np.inf)
        np.maximum.at(best_turn, image, turn)
        good = (own <= 4.0 * np.quantile(own, 0.4)) & (turn == best_turn[image])
        if good.sum() < 3:
            return best
        X, Z = solve_many(A[None, good], B[None, good])
        new = Start(X[0], Z[0], image_errors(data, camera, X, Z)[0])
        seen = np.bincount(data.image, minlength=data.n) > 0
        if _score(new, seen) >= _score(best, seen) - 1e-9:
            return best
        best = new
    return best

"""Approximate network from identified targets alone: where the cameras stood, where the targets are, focal length.

Seeds come from given coordinates, from a plane (homographies) or from two images (essential matrix), for a set of focal
lengths if none is known; each seed is grown by resection and intersection with intermediate adjustments, and the one
that explains the most marks wins.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from robcal.errors import DegenerateGeometry
from robcal.photogrammetry.bundle.datum import Datum
from robcal.photogrammetry.bundle.determinacy import intrinsics_basis
from robcal.photogrammetry.bundle.normals import MarkOrder, State
from robcal.photogrammetry.bundle.solver import Bars, Problem, minimise
from robcal.photogrammetry.core.camera import Camera, project
from robcal.photogrammetry.core.network import ImageMarks
from robcal.photogrammetry.orientation.robust_pose import ideal_points, robust_pose, truncated_cost
from robcal.photogrammetry.orientation.start_planar import best_references, planar_starts, plane_share
from robcal.transforms import Array, frame


@dataclass(frozen=True)
class Approximate:
    """Approximate values of a network: stations (n, 4, 4) and points (t, 3), NaN where there are none yet."""

    camera: Camera
    camera_T_body: Array
    points: Array

    @property
    def placed(self) -> NDArray[np.bool_]:
        """(n,) images with a station."""
        return np.isfinite(self.camera_T_body[:, 0, 0])

    @property
    def located(self) -> NDArray[np.bool_]:
        """(t,) targets with coordinates."""
        return np.isfinite(self.points[:, 0])


@dataclass(frozen=True)
class StartNetwork(Approximate):
    """Approximate network of identified marks: whether each mark (m,) fits, and the robust cost of all."""

    fits: NDArray[np.bool_]
    cost: float


def approximate_network(
    marks: ImageMarks,
    images: int,
    targets: int,
    camera: Camera,
    *,
    focal_known: bool,
    known_points: Array | None = None,
) -> StartNetwork:
    """Approximate values of a network of identified marks.

    Parameters
    ----------
    camera : start values; with ``focal_known`` false only its size is believed.
    known_points : (t, 3) m start coordinates, NaN where unknown, or None.

    Raises
    ------
    DegenerateGeometry : no seed explains at least two images.
    """
    builder = _Builder(marks, images, targets, camera, focal_known)
    candidates: list[StartNetwork] = []
    core = builder.core_images()
    for seed_network in builder.seeds(known_points, core):
        grown = builder.grow(seed_network, core)
        if grown is not None:
            candidates.append(grown)
        # a clear success needs no rivals
        if grown is not None and builder.is_good(grown, core):
            break
    if not candidates:
        raise DegenerateGeometry(
            "no two images could be oriented to each other: every image should show at least six coded targets that "
            "other images show too, from directions 20 to 60 degrees apart"
        )
    best = min(candidates, key=lambda s: s.cost)
    full = builder.grow(best, np.arange(images), final=True)
    if full is None:
        raise DegenerateGeometry("the images do not fit together: check that they all show the same body at rest")
    return full


class _Builder:
    """Marks of one body and the steps that place images and targets."""

    def __init__(self, marks: ImageMarks, images: int, targets: int, camera: Camera, focal_known: bool) -> None:
        self.marks, self.images, self.targets = marks, images, targets
        self.camera, self.focal_known = camera, focal_known
        self.size = float(max(camera.width, camera.height))
        self.rows = [np.flatnonzero(marks.image == j) for j in range(images)]
        seen = np.zeros((images, targets))
        seen[marks.image, marks.target] = 1.0
        self.common = seen @ seen.T

    def core_images(self, count: int = 12) -> NDArray[np.int64]:
        """A well connected subset on which candidates are compared."""
        common = self.common.copy()
        np.fill_diagonal(common, 0.0)
        chosen = [int(np.argmax(np.sum(np.minimum(common, 20.0) * (common >= 5), axis=1)))]
        while len(chosen) < min(count, self.images):
            link = np.max(common[chosen], axis=0)
            link[chosen] = -1.0
            options = np.flatnonzero(link >= min(8.0, link.max()))
            if link.max() < 4:
                break
            # of the well linked ones take that which shares least with all chosen: the most different view
            chosen.append(int(options[np.argmin(common[chosen][:, options].sum(axis=0))]))
        return np.array(chosen, dtype=np.int64)

    def focal_candidates(self) -> list[float]:
        """Focal lengths to try, in px."""
        if self.focal_known:
            return [self.camera.fx]
        return [self.size * factor for factor in (1.2, 0.85, 1.7, 2.4, 0.6, 3.4, 4.5)]

    def with_focal(self, focal: float) -> Camera:
        """The start camera with another focal length."""
        if self.focal_known:
            return self.camera
        return replace(self.camera, fx=focal, fy=focal)

    def empty(self, camera: Camera) -> StartNetwork:
        """A network with nothing placed."""
        poses = np.full((self.images, 4, 4), np.nan)
        points = np.full((self.targets, 3), np.nan)
        return StartNetwork(camera, poses, points, np.zeros(len(self.marks), dtype=bool), np.inf)

    def seeds(self, known_points: Array | None, core: NDArray[np.int64]) -> Iterator[StartNetwork]:
        """Seeds in the order of promise, made only when the earlier ones have failed."""
        if known_points is not None and np.count_nonzero(np.isfinite(known_points[:, 0])) >= 4:
            for f in self.focal_candidates():
                yield replace(self.empty(self.with_focal(f)), points=np.array(known_points))
        references = best_references(self.marks, self.images, self.targets)
        flat = len(references) > 0 and plane_share(self.marks, int(references[0]), self.targets, self.size) > 0.8
        makers = [self._planes(references), self._pairs(core)]
        for maker in makers if flat else makers[::-1]:
            yield from maker

    def _planes(self, references: NDArray[np.int64]) -> Iterator[StartNetwork]:
        for reference in references:
            for start in planar_starts(self.marks, int(reference), self.targets, self.camera, self.focal_known):
                yield replace(self.empty(self.with_focal(start.focal)), points=start.points)

    def _pairs(self, core: NDArray[np.int64]) -> Iterator[StartNetwork]:
        pairs = [(int(i), int(j)) for a, i in enumerate(core) for j in core[:a] if self.common[i, j] >= 6]
        pairs.sort(key=lambda p: -self.common[p])
        for i, j in pairs[:6]:
            for focal in self.focal_candidates():
                found = self._relative(i, j, self.with_focal(focal))
                if found is not None:
                    yield found

    def _relative(self, i: int, j: int, camera: Camera) -> StartNetwork | None:
        """Two-view seed by the essential matrix."""
        target, rows_i, rows_j = np.intersect1d(
            self.marks.target[self.rows[i]], self.marks.target[self.rows[j]], return_indices=True
        )
        a = ideal_points(camera, self.marks.xy[self.rows[i][rows_i]])
        b = ideal_points(camera, self.marks.xy[self.rows[j][rows_j]])
        threshold = 0.004 * self.size / camera.fx
        try:
            E, mask = cv2.findEssentialMat(a, b, np.eye(3), cv2.RANSAC, 0.999, threshold)
        except cv2.error:
            return None  # too few or degenerate points for this pair; other pairs follow
        if E is None or E.shape[0] < 3:
            return None
        best: StartNetwork | None = None
        for k in range(0, E.shape[0], 3):
            count, R, t, _ = cv2.recoverPose(E[k : k + 3], a, b, np.eye(3), mask=mask.copy())
            if count < 5:
                continue
            network = self.empty(camera)
            network.camera_T_body[i] = np.eye(4)
            network.camera_T_body[j] = frame(R, t.ravel())
            self._intersect(network, target, min_angle=np.radians(4.0))
            if np.count_nonzero(network.located) >= 5 and (
                best is None or np.count_nonzero(network.located) > np.count_nonzero(best.located)
            ):
                best = network
        return best

    def tolerance(self, final: bool) -> float:
        """Expected size of good residuals in px while the distortion is not known yet."""
        return self.size * (0.0015 if final else 0.004)

    def _intersect(self, network: StartNetwork, targets: NDArray[np.int64], min_angle: float) -> None:
        """Forward intersection of targets that are not located yet, in place."""
        ideal = ideal_points(network.camera, self.marks.xy)
        placed = network.placed
        R, t = network.camera_T_body[:, :3, :3], network.camera_T_body[:, :3, 3]
        limit = 3.0 * self.tolerance(False)
        for target in targets:
            rows = np.flatnonzero((self.marks.target == target) & placed[self.marks.image])
            if len(rows) < 2:
                continue
            j = self.marks.image[rows]
            u = np.concatenate([ideal[rows], np.ones((len(rows), 1))], axis=1)
            u /= np.linalg.norm(u, axis=1, keepdims=True)
            direction = np.einsum("nij,ni->nj", R[j], u)
            centre = -np.einsum("nij,ni->nj", R[j], t[j])
            point = _closest_point(centre, direction)
            if point is None:
                continue
            for _ in range(2):  # once more without the rays that do not meet the others
                p = R[j] @ point + t[j]
                residual = np.linalg.norm(project(network.camera, p) - self.marks.xy[rows], axis=1)
                residual = np.where(np.isfinite(residual), residual, np.inf)
                good = residual < limit
                if good.all() or np.count_nonzero(good) < 2:
                    break
                again = _closest_point(centre[good], direction[good])
                if again is None:
                    break
                point = again
            if np.count_nonzero(good) < 2:
                continue
            cosine = np.min(direction[good] @ direction[good].T)
            if cosine < np.cos(min_angle):
                network.points[target] = point

    def grow(self, network: StartNetwork, images: NDArray[np.int64], *, final: bool = False) -> StartNetwork | None:
        """Place the given images and their targets, adjusting in between; None if fewer than two could be placed."""
        network = replace(network, camera_T_body=network.camera_T_body.copy(), points=network.points.copy())
        adjusted_at = 0
        failed: dict[int, int] = {}
        while True:
            located, placed = network.located, network.placed
            count = {
                int(j): int(np.count_nonzero(located[self.marks.target[self.rows[j]]])) for j in images if not placed[j]
            }
            options = [j for j, c in count.items() if c >= 4 and failed.get(j, 0) < c]
            if not options:
                if np.count_nonzero(placed) > adjusted_at:
                    adjusted_at = int(np.count_nonzero(placed))
                    network = self._adjust(network, final)
                    self._intersect(network, np.flatnonzero(~network.located), np.radians(3.0))
                    continue
                break
            options.sort(key=lambda j: -count[j])
            for j in options[: max(1, int(np.count_nonzero(placed)))]:
                rows = self.rows[j][located[self.marks.target[self.rows[j]]]]
                found = robust_pose(
                    network.camera,
                    network.points[self.marks.target[rows]],
                    self.marks.xy[rows],
                    self.tolerance(adjusted_at > 6),
                )
                if found is None or np.count_nonzero(found.inliers) < max(4, 0.5 * len(rows)):
                    failed[j] = count[j]
                else:
                    network.camera_T_body[j] = found.camera_T_body
            placed_now = int(np.count_nonzero(network.placed))
            if placed_now >= 2 and placed_now > 1.3 * adjusted_at:
                adjusted_at = placed_now
                network = self._adjust(network, final)
                failed.clear()
            self._intersect(network, np.flatnonzero(~network.located), np.radians(3.0))
        if np.count_nonzero(network.placed) < 2:
            return None
        return self._judged(network, images, final)

    def _judged(self, network: StartNetwork, images: NDArray[np.int64], final: bool) -> StartNetwork:
        """Fit of every mark and the cost over all marks of the given images, unplaced ones counted as misfits."""
        length = self._lengths(network)
        scale = self.tolerance(final)
        mine = np.isin(self.marks.image, images)
        cost = float(truncated_cost(length[mine], 0.25 * self.tolerance(False)))
        return replace(network, fits=length < 3.0 * scale, cost=cost)

    def is_good(self, network: StartNetwork, core: NDArray[np.int64]) -> bool:
        """Most marks of the core are reached, and nearly all of these fit within a thousandth of the image."""
        length = self._lengths(network)[np.isin(self.marks.image, core)]
        reached = length[np.isfinite(length)]
        return (
            len(reached) > 0.6 * len(length)
            and bool(np.mean(reached < 0.001 * self.size) > 0.9)
            and (self.focal_known or bool(np.median(reached) < 5e-4 * self.size))
        )

    def _lengths(self, network: StartNetwork) -> Array:
        out = np.full(len(self.marks), np.inf)
        usable = network.placed[self.marks.image] & network.located[self.marks.target]
        rows = np.flatnonzero(usable)
        T, X = network.camera_T_body[self.marks.image[rows]], network.points[self.marks.target[rows]]
        p = np.einsum("nij,nj->ni", T[:, :3, :3], X) + T[:, :3, 3]
        length = np.linalg.norm(project(network.camera, p) - self.marks.xy[rows], axis=1)
        out[rows] = np.where(np.isfinite(length), length, np.inf)
        return out

    def _adjust(self, network: StartNetwork, final: bool) -> StartNetwork:
        """Robust adjustment of what is placed; more of the interior orientation as more images carry it."""
        usable = network.placed[self.marks.image] & network.located[self.marks.target]
        usable &= self._lengths(network) < 12.0 * self.tolerance(False)
        while True:
            rays = np.bincount(self.marks.target[usable], minlength=self.targets)
            load = np.bincount(self.marks.image[usable], minlength=self.images)
            keep = usable & (rays[self.marks.target] >= 2) & (load[self.marks.image] >= 4)
            if np.array_equal(keep, usable):
                break
            usable = keep
        rows = np.flatnonzero(usable)
        images, targets = np.unique(self.marks.image[rows]), np.unique(self.marks.target[rows])
        points, poses = network.points.copy(), network.camera_T_body.copy()
        points[np.setdiff1d(np.flatnonzero(network.located), targets)] = np.nan
        if len(images) < 2 or len(targets) < 5:
            return network
        compact = self.marks.select(rows)
        compact = replace(
            compact,
            image=np.searchsorted(images, compact.image),
            target=np.searchsorted(targets, compact.target),
            covariance=np.tile(np.eye(2), (len(rows), 1, 1)),
        )
        order = MarkOrder(compact, len(images), len(targets))
        state = State(network.camera, poses[images], points[targets])
        datum = Datum("inner", np.arange(len(targets)), True, "")
        for names in self._stages(len(images), final):
            problem = Problem(
                order,
                intrinsics_basis(names),
                datum,
                Bars.none(),
                np.zeros(len(targets)),
                None,
                np.zeros(len(rows), np.int64),
                np.ones(1),
            )
            try:
                moved, _ = minimise(problem, state, robust=2.0, max_iterations=25, tolerance=1e-4)
            except DegenerateGeometry:
                break  # the located targets still lie in one line; more images will change that
            if _plausible(moved.camera, self.size):
                state = moved
        poses[images], points[targets] = state.camera_T_body, state.points
        return replace(network, camera=state.camera, camera_T_body=poses, points=points)

    def _stages(self, images: int, final: bool) -> list[tuple[str, ...]]:
        first: tuple[str, ...] = () if self.focal_known else ("f",)
        stages = [first]
        if images >= 4:
            stages.append(("f", "k1"))
        if images >= 8:
            stages.append(("f", "cx", "cy", "k1", "k2", "p1", "p2"))
        return stages


def _plausible(camera: Camera, size: float) -> bool:
    values = camera.vector
    return bool(np.all(np.isfinite(values)) and 0.15 * size < camera.fx < 30.0 * size and abs(camera.k1) < 20.0)


def _closest_point(centre: Array, direction: Array) -> Array | None:
    """Point closest to rays (n, 3); None if they are parallel."""
    P = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    A = P.sum(axis=0)
    if np.linalg.eigvalsh(A)[0] < 1e-6 * len(direction):
        return None
    return np.linalg.solve(A, np.einsum("nij,nj->i", P, centre))

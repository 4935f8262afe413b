"""The steps of a survey: start, adjustment, matching of uncoded dots, late images, frame and names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robcal.errors import InvalidInput, NotIdentifiable
from robcal.photogrammetry.bundle.adjustment import AdjustSettings, adjust
from robcal.photogrammetry.bundle.body_frame import Similarity, body_frame, fit_similarity
from robcal.photogrammetry.bundle.datum import DatumWish, InnerOver, spans_triangle
from robcal.photogrammetry.bundle.start_network import StartNetwork, approximate_network
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.discs import Discs, discs_from_ellipses, facing_normals, modelled_discs, size_ratio
from robcal.photogrammetry.core.eccentricity import body_normals
from robcal.photogrammetry.core.network import CameraNetwork, IntArray, Lengths, RejectedMark
from robcal.photogrammetry.survey.images import Collection
from robcal.photogrammetry.survey.late_images import place_late
from robcal.photogrammetry.survey.matching import Geometry, find_new_points, is_dot, match_known, seen_diameters
from robcal.photogrammetry.survey.plausibility import rough_scale, scale_notes
from robcal.photogrammetry.survey.types import BodyTarget, SurveyResult, SurveySettings
from robcal.transforms import Array

_FIRST_NEW_ID = 4096
"""Ids given by the survey start here: above all ring12 codes."""
_ROUNDS = 5
"""Rounds of matching and adjustment at most; usually three suffice."""


class Survey:
    """The steps of a survey over one collection of detections."""

    def __init__(
        self,
        collection: Collection,
        targets: Sequence[BodyTarget],
        size: tuple[int, int],
        camera: Camera | None,
        bars: Lengths,
        checks: Lengths,
        settings: SurveySettings,
    ) -> None:
        self.data, self.targets, self.settings = collection, targets, settings
        self.camera_given = camera
        self.camera = camera or Camera.from_size(*size)
        self.bars, self.checks = bars, checks
        self.unused = list(collection.unused)
        self.notes: list[str] = list(collection.notes)
        self.given = {t.id: np.array(t.xyz, dtype=float) for t in targets if t.id is not None and t.xyz is not None}
        self.diameter = {t.id: t.diameter for t in targets if t.id is not None and t.diameter}
        common = {t.diameter for t in targets if t.diameter and t.code is None}
        self.common_diameter = common.pop() if len(common) == 1 else None
        # targets of the network in the making: ids, assigned detections
        self.ids: list[int] = []
        # what the ellipses say about the discs, of the targets with these ids, in the scale of the last adjustment
        self.size_ratio: float | None = None
        self._discs: tuple[list[int], Discs] | None = None
        self.new_rows: set[int] = set()
        self.rejected: list[RejectedMark] = []
        self._new_name: dict[int, int] = {}
        # start coordinates of targets found since the last adjustment
        self._pending: dict[int, Array] = {}
        self._pending_stations: dict[int, Array] = {}
        self.adjust_settings = replace(settings.adjust, hold_focal=settings.adjust.hold_focal or camera is not None)

    def given_points(self) -> Array:
        """(t, 3) given coordinates of the network's targets, NaN where unknown."""
        return np.array([self.given.get(i, np.full(3, np.nan)) for i in self.ids]).reshape(-1, 3)

    def diameters(self) -> Array | None:
        """(t,) known diameters, 0 where unknown."""
        if not self.settings.eccentricity:
            return None
        return np.array(
            [
                (self.common_diameter or 0.0) if row in self.new_rows else (self.diameter.get(i) or 0.0)
                for row, i in enumerate(self.ids)
            ]
        )

    def check_scale(self, datum: str | tuple[int, ...]) -> None:
        """Something must give the scale."""
        if isinstance(datum, tuple):
            missing = sorted(i for i in datum if i not in self.given)
            if missing:
                raise InvalidInput(f"targets {missing} of the fixed datum have no coordinates: give xyz_mm")
            return
        seen = set(self.data.ids.tolist())
        if len(self.bars) == 0 and len([i for i in self.given if i in seen]) < 2:
            raise NotIdentifiable(
                "nothing gives the scale: photograph a scale bar (scale_bars) or give the coordinates of two targets",
                ("scale",),
            )

    def start(self) -> StartNetwork:
        """Approximate network from the identified detections."""
        rows = np.flatnonzero(self.data.assigned >= 0)
        self.ids = [int(i) for i in self.data.ids]
        marks = self.data.marks(rows, np.ones(len(rows)))
        known = self.given_points()
        start = approximate_network(
            marks,
            len(self.data.names),
            len(self.ids),
            self.camera,
            focal_known=self.camera_given is not None,
            known_points=known if np.isfinite(known).any() else None,
            seed=self.settings.seed,
        )
        for j in np.flatnonzero(~start.placed):
            count = int(np.count_nonzero(marks.image == j))
            reason = (
                f"only {count} identified targets" if count < 4 else "its targets do not fit those of the other images"
            )
            self.unused.append((self.data.names[j], reason))
        # a mark far off its place is no mark of that target; it may still be one of another
        misfits = rows[~start.fits & start.placed[marks.image] & start.located[marks.target]]
        for row in misfits:
            self._reject(int(row), "far from where the other images place this target (wrong id?)")
        self.data.assigned[misfits] = -1
        return start

    def _reject(self, row: int, reason: str) -> None:
        xy = self.data.xy[row]
        self.rejected.append(
            RejectedMark(
                self.data.names[int(self.data.image[row])],
                self.ids[int(self.data.assigned[row])],
                (float(xy[0]), float(xy[1])),
                (float("nan"), float("nan")),
                float("nan"),
                reason,
            )
        )

    def _adjust(
        self,
        camera: Camera,
        poses: Array,
        points: Array,
        placed: NDArray[np.bool_],
        located: NDArray[np.bool_],
        *,
        datum: DatumWish = "free",
        lengths: Lengths | None = None,
        checks: Lengths | None = None,
        free: Sequence[str] | None = None,
        settings: AdjustSettings | None = None,
    ) -> CameraNetwork:
        """Adjust all assigned detections of placed images and located targets."""
        image_rows, target_rows = np.flatnonzero(placed), np.flatnonzero(located)
        use = (self.data.assigned >= 0) & placed[self.data.image]
        use &= located[np.maximum(self.data.assigned, 0)]
        marks = self.data.marks(np.flatnonzero(use))
        marks = replace(
            marks, image=np.searchsorted(image_rows, marks.image), target=np.searchsorted(target_rows, marks.target)
        )
        stated = self.diameters()
        diameters, normals = None, None
        if stated is not None:
            axes, angle = self.data.semi_axes[use], self.data.angle[use]
            seen = discs_from_ellipses(
                camera, poses[image_rows], points[target_rows], marks.image, marks.target, axes, angle
            )
            self._discs = [self.ids[i] for i in target_rows], seen
            self.size_ratio = size_ratio(seen, stated[target_rows])
            diameters, normals = modelled_discs(seen, stated[target_rows], points[target_rows])
        return adjust(
            marks,
            camera,
            poses[image_rows],
            points[target_rows],
            ids=np.array(self.ids)[target_rows],
            image_names=[self.data.names[i] for i in image_rows],
            lengths=lengths,
            check_lengths=checks,
            datum=datum,
            diameters=diameters,
            normals=normals,
            free_intrinsics=self.settings.free_intrinsics if free is None else free,
            settings=settings or self.adjust_settings,
        )

    def first_adjustment(self) -> CameraNetwork:
        """Adjust the identified targets alone; what they cannot determine yet is held until more is known."""
        start = self.start()
        settings = self.adjust_settings
        if self.data.has_free():
            settings = replace(settings, hold_focal=True)
        network = self._adjust(
            start.camera, start.camera_T_body, start.points, start.placed, start.located, settings=settings
        )
        self._take_over(network)
        return network

    def _take_over(self, network: CameraNetwork) -> None:
        """Rejected marks lose their assignment; images and targets that dropped out are noted."""
        by_name = {name: i for i, name in enumerate(self.data.names)}
        by_id = {i: row for row, i in enumerate(self.ids)}
        for mark in network.rejected:
            image, target = by_name[mark.image], by_id[mark.target]
            hit = (self.data.image == image) & (self.data.assigned == target)
            hit &= np.all(self.data.xy == np.array(mark.xy), axis=1)
            self.data.assigned[hit] = -1
            self.data.barred[hit] = True
        self.rejected += list(network.rejected)

    def match(self, network: CameraNetwork) -> CameraNetwork:
        """Find the uncoded dots: known points first, then new ones, each time followed by an adjustment."""
        if not self.data.has_free():
            return network
        # what is found sharpens the predictions for what is still missing
        for round_ in range(_ROUNDS):
            before = int(np.count_nonzero(self.data.assigned >= 0))
            if round_ > 0:
                self._place_late(network)
            self._match_known(network)
            if self.settings.new_points:
                self._identify_given(network)
                self._find_new(network)
            gained = int(np.count_nonzero(self.data.assigned >= 0)) - before
            if gained == 0 and round_ > 0:
                break
            last = round_ == _ROUNDS - 1 or gained < 0.02 * before
            settings = self.adjust_settings if last else replace(self.adjust_settings, hold_focal=True)
            network = self._readjust(network, settings=settings)
            self._take_over(network)
        if "fx" not in network.free_intrinsics and not self.adjust_settings.hold_focal:
            # held only for the time of the matching; now it must be determined, or be said not to be
            network = self._readjust(network)
            self._take_over(network)
        return network

    def _readjust(
        self,
        network: CameraNetwork,
        *,
        datum: DatumWish = "free",
        lengths: Lengths | None = None,
        checks: Lengths | None = None,
        free: Sequence[str] | None = None,
        settings: AdjustSettings | None = None,
        frame: Similarity | None = None,
    ) -> CameraNetwork:
        poses, points, placed, located = self._spread(network)
        if frame is not None:
            poses[placed] = frame.stations(poses[placed])
            points[located] = frame.points(points[located])
        if isinstance(datum, tuple):
            rows = [self.ids.index(i) for i in datum if i in self.ids]
            points[rows] = self.given_points()[rows]
        return self._adjust(
            network.camera,
            poses,
            points,
            placed,
            located,
            datum=datum,
            lengths=lengths,
            checks=checks,
            free=free,
            settings=settings,
        )

    def _spread(self, network: CameraNetwork) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Values of a network over all images and targets: stations, points, placed, located."""
        poses = np.full((len(self.data.names), 4, 4), np.nan)
        points = np.full((len(self.ids), 3), np.nan)
        by_name = {name: i for i, name in enumerate(self.data.names)}
        by_id = {i: row for row, i in enumerate(self.ids)}
        poses[[by_name[name] for name in network.image_names]] = network.camera_T_body
        points[[by_id[int(i)] for i in network.ids]] = network.points
        for row, point in self._pending.items():
            points[row] = point
        for image, station in self._pending_stations.items():
            if not np.isfinite(poses[image, 0, 0]):
                poses[image] = station
        return poses, points, np.isfinite(poses[:, 0, 0]), np.isfinite(points[:, 0])

    def _sightings(self, network: CameraNetwork, late: Sequence[str] = ()) -> tuple[IntArray, IntArray, IntArray]:
        """Usable detections (rows), their image in the network and their target in it (-1 none, -2 not in it)."""
        by_name = {name: i for i, name in enumerate([*network.image_names, *late])}
        compact = np.array([by_name.get(name, -1) for name in self.data.names])
        rows = np.flatnonzero((compact[self.data.image] >= 0) & ~self.data.barred)
        to_network = {int(i): row for row, i in enumerate(network.ids)}
        assigned = np.array(
            [to_network.get(self.ids[a], -2) if a >= 0 else -1 for a in self.data.assigned[rows]], dtype=np.int64
        )
        return rows, compact[self.data.image[rows]], assigned

    def _match_known(self, network: CameraNetwork) -> None:
        late = [self.data.names[j] for j in self._pending_stations]
        rows, image, assigned = self._sightings(network, late)
        sightings = self.data.sightings(rows, image)
        gate = 0.004 * max(self.camera.width, self.camera.height)
        normals = body_normals(network.points)
        flat = np.linalg.matrix_rank(normals[np.isfinite(normals).all(axis=1)], tol=1e-3) < 2
        if flat:
            normals = np.full_like(normals, np.nan)
        geometry = Geometry.of(network)
        if late:
            # placed by dots within a few pixels: the gate's upper limit decides
            loose = np.tile(np.diag([1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6]), (len(late), 1, 1))
            geometry = geometry.with_stations(np.array(list(self._pending_stations.values())), loose)
        found = match_known(geometry, sightings, assigned, normals, gate)
        gained = np.flatnonzero((found >= 0) & (assigned == -1))
        by_id = {i: row for row, i in enumerate(self.ids)}
        for g in gained:
            self.data.assigned[rows[g]] = by_id[int(network.ids[found[g]])]

    def _identify_given(self, network: CameraNetwork) -> None:
        """Uncoded targets with given coordinates: predicted through the fit of those that are known already."""
        have = {int(i) for i in network.ids}
        common = [i for i in self.given if i in have]
        missing = [i for i in self.given if i not in have]
        if len(common) < 3 or not missing:
            return
        p_given = np.array([self.given[i] for i in common])
        p_network = network.points[network.index_of(common)]
        if not (spans_triangle(p_given) and spans_triangle(p_network)):
            return
        fit = fit_similarity(p_network, p_given, with_scale=True)
        spread = float(np.median(np.linalg.norm(p_network - fit.points(p_given), axis=1)))
        points = fit.points(np.array([self.given[i] for i in missing]))
        rows, image, assigned = self._sightings(network)
        # nominal coordinates are only as good as those of the common targets show
        sigma = max(3.0 * spread, 1e-6 * float(np.ptp(p_network)))
        geometry = Geometry.of(network).with_points(points, np.tile(sigma**2 * np.eye(3), (len(points), 1, 1)))
        gate = 0.01 * max(self.camera.width, self.camera.height)
        none = np.full_like(geometry.points, np.nan)
        found = match_known(geometry, self.data.sightings(rows, image), assigned, none, gate)
        base = len(network.points)
        for q, identity in enumerate(missing):
            mine = rows[(found == base + q) & (assigned == -1)]
            if len(mine) >= 2:
                row = self._row_of(identity)
                self.data.assigned[mine] = row
                self._pending = {**self._pending, row: points[q]}

    def _place_late(self, network: CameraNetwork) -> None:
        """Stations for images with three identified targets; their marks then come from the matching."""
        by_id = {int(i): row for row, i in enumerate(network.ids)}
        for image, name in enumerate(self.data.names):
            if name in network.image_names or image in self._pending_stations:
                continue
            rows = np.flatnonzero((self.data.image == image) & ~self.data.barred)
            coded = [r for r in rows[self.data.assigned[rows] >= 0] if self.ids[self.data.assigned[r]] in by_id]
            if len(coded) != 3:
                continue
            known = np.array([by_id[self.ids[self.data.assigned[r]]] for r in coded])
            gate = 0.005 * max(self.camera.width, self.camera.height)
            T = place_late(network.camera, network.points, known, self.data.xy[coded], self.data.xy[rows], gate)
            if T is not None:
                self._pending_stations[image] = T
                self.unused = [(n, reason) for n, reason in self.unused if n != name]

    def _row_of(self, identity: int) -> int:
        if identity not in self.ids:
            self.ids.append(identity)
        return self.ids.index(identity)

    def _find_new(self, network: CameraNetwork) -> None:
        rows, image, assigned = self._sightings(network)
        taken = self.data.assigned[rows] >= 0
        assigned = np.where(taken & (assigned < 0), 0, assigned)
        centre = 0.5 * (network.points.min(axis=0) + network.points.max(axis=0))
        radius = self.settings.reach * float(np.max(np.linalg.norm(network.points - centre, axis=1)))
        found = find_new_points(
            Geometry.of(network),
            self.data.sightings(rows, image),
            assigned,
            centre=centre,
            radius=radius,
            min_images=max(self.settings.min_images, min(4, len(network.image_names) // 3)),
        )
        pending = dict(self._pending)
        geometry = Geometry.of(network)
        sizes = self._plausible_sizes(geometry, rows, image, assigned)
        for point, members in zip(found.points, found.members, strict=True):
            diameter = seen_diameters(geometry, point, image[members], self.data.semi_axes[rows[members], 0])
            if not is_dot(diameter, sizes):
                continue
            row = len(self.ids)
            self.ids.append(-1 - row)  # named at the end
            self.new_rows.add(row)
            self.data.assigned[rows[members]] = row
            pending[row] = point
        self._pending = pending

    def _plausible_sizes(self, geometry: Geometry, rows: IntArray, image: IntArray, assigned: IntArray) -> Array:
        """(q, 2) smallest and largest diameters in m (in the network's present scale) that a new dot may have.

        Listed diameters of uncoded targets are believed to 30 %; without them a dot may be 0.4 to 2.5 times as large as
        the known targets.
        """
        mine = np.flatnonzero((assigned >= 0) & (assigned < len(geometry.points)))
        if len(mine) == 0:
            return np.zeros((0, 2))
        points = geometry.points[assigned[mine]]
        seen = seen_diameters(geometry, points, image[mine], self.data.semi_axes[rows[mine], 0])
        usual = float(np.nanmedian(seen)) if np.isfinite(seen).any() else np.nan
        if not np.isfinite(usual):
            return np.zeros((0, 2))
        blank = [t for t in self.targets if t.code is None and t.xyz is None]
        listed = {t.diameter for t in blank if t.diameter}
        known = [self.diameter.get(self.ids[self.data.assigned[rows[r]]]) for r in mine]
        stated = np.array([np.nan if d is None else d for d in known])
        if listed and all(t.diameter for t in blank) and np.isfinite(stated).any():
            scale = float(np.nanmedian(seen / stated))
            return np.array([[0.7 * scale * d, 1.3 * scale * d] for d in sorted(listed)])
        return np.array([[0.4 * usual, 2.5 * usual]])

    def finish(self, network: CameraNetwork, datum: str | tuple[int, ...]) -> tuple[CameraNetwork, str, str]:
        """Scale, frame and names; the last adjustment gives the covariances in the final datum."""
        self._pending, self._pending_stations = {}, {}
        have = {int(i) for i in network.ids}
        unseen = sorted({int(v) for v in self.bars.ids.ravel()} - have)
        if unseen:
            raise InvalidInput(
                f"scale bar targets {unseen} are not measured in two images: photograph them or check the ids"
            )
        if isinstance(datum, tuple):
            missing = sorted(set(datum) - have)
            if missing:
                raise InvalidInput(f"targets {missing} of the fixed datum are not measured in two images")
        self._name_new(network)
        ids = np.array([self._new_name.get(int(i), int(i)) for i in network.ids])
        network = replace(network, ids=ids)
        given = np.array([self.given.get(int(i), np.full(3, np.nan)) for i in network.ids])
        if len(self.bars):
            # to metres first: sizes of dots must be in the scale of the coordinates
            rough = Similarity(rough_scale(network, self.bars), np.eye(4), "scale bars")
            self.notes += scale_notes(network, given, self.bars, self.checks, rough.scale, self.size_ratio)
            network = self._readjust(network, lengths=self.bars, checks=self.checks, frame=rough)
            self._take_over(network)
            given = np.array([self.given.get(int(i), np.full(3, np.nan)) for i in network.ids])
        known = [int(i) for i, g in zip(network.ids, given, strict=True) if np.isfinite(g).all()]
        R, t = network.camera_T_body[:, :3, :3], network.camera_T_body[:, :3, 3]
        stations = -np.einsum("nij,ni->nj", R, t)
        frame = body_frame(network.points, network.ids, given, stations, with_scale=len(self.bars) == 0)
        if len(self.bars) == 0:
            self.notes += scale_notes(network, given, self.bars, self.checks, frame.scale, self.size_ratio)
        if len(self.bars) == 0 and not isinstance(datum, tuple) and len(known) < 2:
            raise NotIdentifiable(
                "fewer than two targets with given coordinates were found, so nothing gives the scale: photograph a "
                "scale bar or give more coordinates",
                ("scale",),
            )
        wish: DatumWish = datum
        if not isinstance(datum, tuple) and datum == "free" and len(known) >= 3 and "given" in frame.words:
            wish = InnerOver(tuple(known))
        settings = replace(self.adjust_settings, robust=False, snooping=False)
        network = self._readjust(
            network,
            datum=wish,
            lengths=self.bars,
            checks=self.checks,
            free=network.free_intrinsics,
            settings=settings,
            frame=frame,
        )
        self._take_over(network)
        words = f"targets {sorted(datum)} held at their given coordinates" if isinstance(datum, tuple) else frame.words
        scale = f"{len(self.bars)} scale bars" if len(self.bars) else "the given coordinates"
        return network, words, scale

    def _name_new(self, network: CameraNetwork) -> None:
        """Ids for new points: those listed without coordinates first, then fresh ones."""
        new = [int(i) for i in network.ids if i < 0]
        have = set(self.ids)
        blank = [t for t in self.targets if t.code is None and t.xyz is None]
        listed = [t.id for t in blank if t.id is not None and t.id not in have]
        rays = np.bincount(network.marks.target, minlength=len(network.ids))
        rank = {int(i): int(rays[row]) for row, i in enumerate(network.ids)}
        place = {int(i): tuple(network.points[row]) for row, i in enumerate(network.ids)}
        new.sort(key=lambda i: -rank[i])
        chosen = sorted(new[: len(listed)], key=lambda i: place[i]) + sorted(new[len(listed) :], key=lambda i: place[i])
        fresh = max([_FIRST_NEW_ID - 1, *have, *(t.id for t in self.targets if t.id is not None)]) + 1
        names: dict[int, int] = {}
        for position, old in enumerate(chosen):
            names[old] = listed[position] if position < len(listed) else fresh + position - len(listed)
        self._new_name = names
        self.ids = [names.get(i, i) for i in self.ids]

    def result(self, network: CameraNetwork, frame: str, scale: str, engine: str) -> SurveyResult:
        """Put together what there is to say."""
        have = {int(i) for i in network.ids}
        seen_names = set(network.image_names)
        unused = dict(self.unused)
        for name in self.data.names:
            if name not in seen_names and name not in unused:
                unused[name] = "too few usable marks were left"
        listed = {t.id for t in self.targets if t.id is not None}
        deviations = [
            (int(i), float(np.linalg.norm(p - self.given[int(i)])))
            for i, p in zip(network.ids, network.points, strict=True)
            if int(i) in self.given
        ]
        normals = np.full((len(network.ids), 3), np.nan)
        if self._discs is not None:
            ids, seen = self._discs
            rows = [ids.index(int(i)) for i in network.ids]
            normals = facing_normals(network.normals, seen.select(np.array(rows, dtype=np.int64)))
        named = [replace(r, target=self._new_name.get(r.target, r.target)) for r in self.rejected]
        network = replace(network, rejected=tuple(dict.fromkeys(named)))
        return SurveyResult(
            network=network,
            frame=frame,
            scale=scale,
            new_ids=tuple(sorted(i for i in self._new_name.values() if i in have and i not in listed)),
            unseen_ids=tuple(sorted(i for i in listed if i not in have)),
            unused_images=tuple(unused.items()),
            free_detections=int(np.count_nonzero(self.data.assigned < 0)),
            deviations=tuple(deviations),
            engine=engine,
            normals=normals,
            notes=tuple(dict.fromkeys([*self.notes, *network.notes])),
        )

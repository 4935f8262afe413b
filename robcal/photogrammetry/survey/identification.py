"""Rounds of matching and adjustment that find the uncoded dots, the late images and the new targets of a survey.

Images with only three identified targets: placed once the rest of the network is known.

Three points leave up to four poses; the other known targets, which must meet detections, select the right one.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from robcal.errors import DegenerateGeometry
from robcal.photogrammetry.bundle.body_frame import fit_similarity
from robcal.photogrammetry.bundle.datum import spans_triangle
from robcal.photogrammetry.core.camera import Camera, project
from robcal.photogrammetry.core.eccentricity import body_normals
from robcal.photogrammetry.core.network import CameraNetwork, IntArray
from robcal.photogrammetry.orientation.closed_form import start_poses
from robcal.photogrammetry.orientation.robust_pose import refine_robust
from robcal.photogrammetry.survey.adjusting import Adjusted, Step, readjust
from robcal.photogrammetry.survey.assignments import Assignments, sightings_in
from robcal.photogrammetry.survey.matching import Geometry, is_dot, match_known, seen_diameters
from robcal.photogrammetry.survey.new_points import find_new_points
from robcal.photogrammetry.survey.types import SurveyInput
from robcal.transforms import Array, transform

_MATCHES = 8
_SHARE = 0.5


def place_late(
    camera: Camera, points: Array, identified: IntArray, xy_identified: Array, xy_all: Array, gate: float
) -> Array | None:
    """camera_T_body (4, 4) of an image with three identified targets, or None if no pose explains the other dots.

    Parameters
    ----------
    points : (t, 3) all known targets. identified : (3,) rows of the identified ones, at ``xy_identified`` (3, 2).
    xy_all : (d, 2) all detections. gate : px within which a target meets a detection.
    """
    try:
        starts = start_poses(camera, xy_identified, points[identified])
    except DegenerateGeometry:
        return None  # three targets in one line carry no pose
    tree = cKDTree(xy_all)
    best: tuple[int, Array] | None = None
    for T in starts:
        for _ in range(3):
            rows, hits = _meetings(camera, T, points, tree, gate)
            if len(rows) < _MATCHES:
                break
            T = refine_robust(camera, T[None], points[rows], xy_all[hits], gate / 3.0)[0]
        rows, hits = _meetings(camera, T, points, tree, gate / 3.0)
        if len(rows) >= max(_MATCHES, _SHARE * len(xy_all)) and (best is None or len(rows) > best[0]):
            best = len(rows), T
    return None if best is None else best[1]


def _meetings(camera: Camera, T: Array, points: Array, tree: cKDTree, gate: float) -> tuple[IntArray, IntArray]:
    """Rows of targets and of the detections they meet, one to one."""
    xy = project(camera, transform(T, points))
    rows = np.flatnonzero(np.isfinite(xy).all(axis=1))
    if len(rows) == 0:
        return rows, rows
    distance, found = tree.query(xy[rows], distance_upper_bound=gate)
    nearest = np.asarray(found, dtype=np.int64)
    close = np.isfinite(distance)
    rows, nearest = rows[close], nearest[close]
    _, first, counts = np.unique(nearest, return_index=True, return_counts=True)
    alone = first[counts == 1]
    return rows[alone], nearest[alone]


FIRST_NEW_ID = 4096
"""Ids given to new targets start here: above all ring12 codes."""
_ROUNDS = 5
"""Rounds of matching and adjustment at most; usually three suffice."""


def identify_uncoded(given: SurveyInput, table: Assignments, adjusted: Adjusted) -> tuple[Assignments, Adjusted]:
    """Find the uncoded dots: known targets first, then new ones, each time followed by an adjustment."""
    if not table.has_free():
        return table, adjusted
    final = Step(given.adjust_settings, given.settings.free_intrinsics)
    provisional = replace(final, settings=replace(final.settings, hold_focal=True))
    # what is found sharpens the predictions for what is still missing
    for round_ in range(_ROUNDS):
        before = table.assigned
        network = adjusted.network
        if round_ > 0:
            table = _place_late(given, table, network)
        table = _match_known(given, table, network)
        if given.settings.new_points:
            table = _identify_given(given, table, network)
            table = _find_new(given, table, network)
        gained = table.assigned - before
        if gained == 0 and round_ > 0:
            break
        last = round_ == _ROUNDS - 1 or gained < 0.02 * before
        table, adjusted = readjust(given, table, network, final if last else provisional)
    if "fx" not in adjusted.network.free_intrinsics and not final.settings.hold_focal:
        # held only for the time of the matching; now it must be determined, or reported as undetermined
        table, adjusted = readjust(given, table, adjusted.network, final)
    return table, adjusted


def _gate(given: SurveyInput, share: float) -> float:
    """Gate in px as a share of the image's longer side."""
    return share * max(given.camera.width, given.camera.height)


def _match_known(given: SurveyInput, table: Assignments, network: CameraNetwork) -> Assignments:
    """Assign detections that lie where targets of the network are predicted."""
    late = table.late_images
    rows, image, target = sightings_in(table, given.detections, network, [given.detections.names[j] for j in late])
    normals = body_normals(network.points)
    flat = np.linalg.matrix_rank(normals[np.isfinite(normals).all(axis=1)], tol=1e-3) < 2
    if flat:
        normals = np.full_like(normals, np.nan)
    geometry = Geometry.of(network)
    if len(late):
        # placed by dots within a few pixels: the gate's upper limit decides
        loose = np.tile(1e-6 * np.eye(6), (len(late), 1, 1))
        geometry = geometry.with_stations(table.late_stations[late], loose)
    found = match_known(geometry, given.detections.sightings(rows, image), target, normals, _gate(given, 0.004))
    gained = np.flatnonzero((found >= 0) & (target == -1))
    row_of = table.row_of()
    return table.assign(rows[gained], np.array([row_of[int(i)] for i in network.ids[found[gained]]], dtype=np.int64))


def _identify_given(given: SurveyInput, table: Assignments, network: CameraNetwork) -> Assignments:
    """Assign uncoded targets with given coordinates, predicted through the fit of those that are known already."""
    have = {int(i) for i in network.ids}
    common = [i for i in given.given if i in have]
    missing = [i for i in given.given if i not in have]
    if len(common) < 3 or not missing:
        return table
    p_given = given.given_points(common)
    p_network = network.points[network.index_of(common)]
    if not (spans_triangle(p_given) and spans_triangle(p_network)):
        return table
    fit = fit_similarity(p_network, p_given, with_scale=True)
    spread = float(np.median(np.linalg.norm(p_network - fit.points(p_given), axis=1)))
    points = fit.points(given.given_points(missing))
    rows, image, target = sightings_in(table, given.detections, network)
    # nominal coordinates are only as good as those of the common targets show
    sigma = max(3.0 * spread, 1e-6 * float(np.ptp(p_network)))
    geometry = Geometry.of(network).with_points(points, np.tile(sigma**2 * np.eye(3), (len(points), 1, 1)))
    any_direction = np.full_like(geometry.points, np.nan)
    sightings = given.detections.sightings(rows, image)
    found = match_known(geometry, sightings, target, any_direction, _gate(given, 0.01))
    for q, target_id in enumerate(missing):
        mine = rows[(found == len(network.points) + q) & (target == -1)]
        if len(mine) >= 2:
            if target_id not in table.ids:
                table = table.append(target_id)
            row = table.row_of()[target_id]
            table = table.assign(mine, row).locate(row, points[q])
    return table


def _place_late(given: SurveyInput, table: Assignments, network: CameraNetwork) -> Assignments:
    """Stations for images with three identified targets; their marks then come from the matching."""
    detections = given.detections
    in_network = {int(i): row for row, i in enumerate(network.ids)}
    stations, unplaced = table.late_stations.copy(), dict(table.unplaced)
    late = set(table.late_images.tolist())
    for image, name in enumerate(detections.names):
        if name in network.image_names or image in late:
            continue
        rows = np.flatnonzero((detections.image == image) & ~table.excluded)
        coded = [r for r in rows[table.target[rows] >= 0] if int(table.ids[table.target[r]]) in in_network]
        if len(coded) != 3:
            continue
        known = np.array([in_network[int(table.ids[table.target[r]])] for r in coded])
        xy, gate = detections.xy, _gate(given, 0.005)
        T = place_late(network.camera, network.points, known, xy[coded], xy[rows], gate)
        if T is not None:
            stations[image] = T
            unplaced.pop(name, None)
    return replace(table, late_stations=stations, unplaced=tuple(unplaced.items()))


def _find_new(given: SurveyInput, table: Assignments, network: CameraNetwork) -> Assignments:
    """Locate new targets from detections that show no known one."""
    detections = given.detections
    rows, image, target = sightings_in(table, detections, network)
    # detections of targets that are not in the network are no new targets
    target = np.where((table.target[rows] >= 0) & (target < 0), 0, target)
    centre = 0.5 * (network.points.min(axis=0) + network.points.max(axis=0))
    geometry = Geometry.of(network)
    found = find_new_points(
        geometry,
        detections.sightings(rows, image),
        target,
        centre=centre,
        radius=given.settings.reach * float(np.max(np.linalg.norm(network.points - centre, axis=1))),
        min_images=max(given.settings.min_images, min(4, len(network.image_names) // 3)),
    )
    sizes = _plausible_sizes(given, table, geometry, rows, image, target)
    first = first_new_id(given, table)
    for point, members in zip(found.points, found.members, strict=True):
        diameter = seen_diameters(geometry, point, image[members], detections.semi_axes[rows[members], 0])
        if not is_dot(diameter, sizes):
            continue
        row = len(table.ids)
        provisional = first + int(np.count_nonzero(table.new))
        table = table.append(provisional, new=True).assign(rows[members], row).locate(row, point)
    return table


def first_new_id(given: SurveyInput, table: Assignments) -> int:
    """The lowest id that no listed or identified target has."""
    known = table.ids[~table.new].tolist()
    return max([FIRST_NEW_ID - 1, *known, *(t.id for t in given.targets if t.id is not None)]) + 1


def _plausible_sizes(
    given: SurveyInput, table: Assignments, geometry: Geometry, rows: IntArray, image: IntArray, target: IntArray
) -> Array:
    """(q, 2) smallest and largest diameters in m (in the network's present scale) that a new dot may have.

    Stated diameters of uncoded targets are believed to 30 %; without them a dot may be 0.4 to 2.5 times as large as
    the known targets.
    """
    mine = np.flatnonzero((target >= 0) & (target < len(geometry.points)))
    if len(mine) == 0:
        return np.zeros((0, 2))
    points = geometry.points[target[mine]]
    seen = seen_diameters(geometry, points, image[mine], given.detections.semi_axes[rows[mine], 0])
    if not np.isfinite(seen).any():
        return np.zeros((0, 2))
    stated_of = given.stated_diameters
    stated = np.array([stated_of.get(int(i), np.nan) for i in table.ids[table.target[rows[mine]]]])
    of_blank = {t.diameter for t in given.blank if t.diameter}
    if of_blank and all(t.diameter for t in given.blank) and np.isfinite(stated).any():
        scale = float(np.nanmedian(seen / stated))
        return np.array([[0.7 * scale * d, 1.3 * scale * d] for d in sorted(of_blank)])
    typical = float(np.nanmedian(seen))
    return np.array([[0.4 * typical, 2.5 * typical]])

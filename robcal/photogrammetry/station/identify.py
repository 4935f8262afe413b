"""Identification over a whole station: images help one another through the other cameras."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robcal.errors import RobcalError
from robcal.imaging.detections import Detections
from robcal.photogrammetry.core.bodies import Body, IntArray
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.identify.extension import IdentifiedImage, Prediction, predict_dots
from robcal.photogrammetry.identify.targets import coded_rows, identify_images, identify_targets
from robcal.photogrammetry.orientation.resection import resect
from robcal.photogrammetry.station.network import StationMarks, StationOrientation, StationSettings
from robcal.photogrammetry.station.orientation import orient_station
from robcal.transforms import Array, invert

_RECURS = 5
_RECURRING_SHARE = 0.6
"""A code is contradicted for good in at least so many images, and in this share of those in which it is read."""
_ENOUGH = 30
"""Marks of an image with which the station is oriented for the second round: a pose from thirty is good to a few
hundredths of a pixel, the gates are whole pixels."""


@dataclass(frozen=True)
class StationIdentification:
    """``marks`` per camera; ``images`` (camera, pose) -> outcome; ``problems`` (camera, pose, reason) of images in
    which nothing (or nothing certain) was identified."""

    marks: Mapping[str, StationMarks]
    images: Mapping[tuple[str, int], IdentifiedImage]
    problems: tuple[tuple[str, int, str], ...]


def identify_station(
    detections: Mapping[str, Mapping[int, Detections]],
    body: Body,
    cameras: Mapping[str, Camera | None],
    *,
    model_error_px: float = 4.0,
) -> StationIdentification:
    """Identify the body's targets in all images of a station.

    First every image by itself (codes, or the search by geometry). If that orients the station, images that stayed
    open and uncoded dots are identified in a second round by the pose that the other cameras saw, with the adjusted
    cameras and a gate of a fraction of a pixel to a few pixels.

    Parameters
    ----------
    detections : camera -> pose number -> detections.
    cameras : start values of the interior orientation or None (then from codes alone in the first round).
    """
    sizes = {
        name: (next(iter(images.values())).shape[1], next(iter(images.values())).shape[0])
        for name, images in detections.items()
        if images
    }
    start = {n: c if (c := cameras.get(n)) is not None else Camera.from_size(*sizes[n]) for n in sizes}
    loose = {n: model_error_px if cameras.get(n) is not None else 4.0 * model_error_px for n in sizes}
    found: dict[tuple[str, int], IdentifiedImage] = {}
    for name in sizes:
        poses = sorted(detections[name])
        # the robot may go anywhere between two poses: the last pose is no prediction
        images = identify_images(
            [detections[name][pose] for pose in poses], body, start[name], model_error_px=loose[name]
        )
        found.update(((name, pose), image) for pose, image in zip(poses, images, strict=True))
    _by_other_views(found, detections, body, start, loose)
    orientation = _orient(found, detections, body, cameras, sizes)
    if orientation is not None:
        _second_round(found, detections, body, orientation)
    found = with_recurring_codes(found, detections, body)
    marks = {name: _marks(name, found, detections[name]) for name in sizes}
    problems = tuple((n, p, image.reason) for (n, p), image in sorted(found.items()) if image.reason)
    return StationIdentification(marks, found, problems)


def with_recurring_codes(
    found: Mapping[tuple[str, int], IdentifiedImage], detections: Mapping[str, Mapping[int, Detections]], body: Body
) -> dict[tuple[str, int], IdentifiedImage]:
    """The images with those codes that the pose of nearly every image contradicts: no misreading recurs like that.

    It is the target that sits elsewhere or carries another one's number; later steps can detect that only if it is
    there.
    """
    read: Counter[int] = Counter()
    against: Counter[int] = Counter()
    thrown: dict[tuple[str, int], tuple[IntArray, IntArray]] = {}
    for (name, pose), image in found.items():
        if image.method == "none":
            continue
        rows, ids = coded_rows(detections[name][pose], body)
        out = ~np.isin(rows, image.rows) & ~np.isin(ids, image.ids)
        thrown[name, pose] = rows[out], ids[out]
        read.update(ids.tolist())
        against.update(ids[out].tolist())
    recurring = [target for target, n in against.items() if n >= max(_RECURS, _RECURRING_SHARE * read[target])]
    result = dict(found)
    for key, (rows, ids) in thrown.items():
        again = np.isin(ids, recurring)
        image = found[key]
        if again.any():
            result[key] = replace(
                image, rows=np.concatenate([image.rows, rows[again]]), ids=np.concatenate([image.ids, ids[again]])
            )
    return result


def _by_other_views(
    found: dict[tuple[str, int], IdentifiedImage],
    detections: Mapping[str, Mapping[int, Detections]],
    body: Body,
    start: Mapping[str, Camera],
    loose: Mapping[str, float],
) -> None:
    """Images of a regular body with several numberings: cameras from similar directions may decide."""
    for (name, pose), image in list(found.items()):
        if image.method != "none" or len(image.alternatives) < 2:
            continue
        others = [v for (n, p), o in found.items() if p == pose and n != name and (v := o.view) is not None]
        if others:
            found[name, pose] = identify_targets(
                detections[name][pose], body, start[name], model_error_px=loose[name], others=others
            )


def _marks(
    name: str, found: Mapping[tuple[str, int], IdentifiedImage], images: Mapping[int, Detections]
) -> StationMarks:
    poses: list[np.ndarray] = []
    ids: list[np.ndarray] = []
    xy: list[np.ndarray] = []
    covariance: list[np.ndarray] = []
    for pose in sorted(images):
        image = found[name, pose]
        poses.append(np.full(len(image.rows), pose))
        ids.append(image.ids)
        xy.append(images[pose].xy[image.rows])
        covariance.append(images[pose].covariance[image.rows])
    if not poses:
        none = np.empty(0, dtype=np.int64)
        return StationMarks(none, none, np.empty((0, 2)), np.empty((0, 2, 2)))
    return StationMarks(np.concatenate(poses), np.concatenate(ids), np.concatenate(xy), np.concatenate(covariance))


def _orient(
    found: Mapping[tuple[str, int], IdentifiedImage],
    detections: Mapping[str, Mapping[int, Detections]],
    body: Body,
    cameras: Mapping[str, Camera | None],
    sizes: Mapping[str, tuple[int, int]],
) -> StationOrientation | None:
    if body.known.sum() < 4:
        return None
    order = spread_order(body.points, body.known)
    marks = {name: _thinned(_marks(name, found, detections[name]), body, order) for name in sizes}
    marks = {name: m for name, m in marks.items() if len(m)}
    if len(marks) == 0:
        return None
    try:
        settings = StationSettings(detect_moves=False, detect_targets=False)
        return orient_station(marks, body, cameras, sizes, settings=settings)
    except RobcalError:
        return None  # the second round is a help only; faults of the station are reported by its own stage


def spread_order(points: Array, known: NDArray[np.bool_]) -> IntArray:
    """Rows of the known points (n, 3) in an order in which the first k are well spread, for every k.

    Farthest point next, from the one farthest from the middle on (Gonzalez 1985).
    """
    rows = np.flatnonzero(known)
    at = points[rows]
    far = np.linalg.norm(at - at.mean(axis=0), axis=1)
    order = []
    for _ in range(len(rows)):
        k = int(np.argmax(far))
        order.append(k)
        to_k = np.linalg.norm(at - at[k], axis=1)
        far = to_k if len(order) == 1 else np.minimum(far, to_k)
        far[k] = -1.0
    return rows[order]


def _thinned(marks: StationMarks, body: Body, order: IntArray) -> StationMarks:
    """At most a few dozen marks of each image, spread over the body: enough to predict the others."""
    rank = np.full(len(body), len(body))
    rank[order] = np.arange(len(order))
    by_pose = np.lexsort((rank[body.index(marks.target)], marks.pose))
    sorted_pose = marks.pose[by_pose]
    within = np.arange(len(by_pose)) - np.searchsorted(sorted_pose, sorted_pose)
    keep = np.sort(by_pose[within < _ENOUGH])
    return StationMarks(marks.pose[keep], marks.target[keep], marks.xy[keep], marks.covariance[keep])


def _second_round(
    found: dict[tuple[str, int], IdentifiedImage],
    detections: Mapping[str, Mapping[int, Detections]],
    body: Body,
    orientation: StationOrientation,
) -> None:
    """Identify again with adjusted cameras and the body's pose as the other cameras (or this one) saw it."""
    ratio = max(1.0, orientation.rms_px)
    for c, name in enumerate(orientation.names):
        camera = orientation.cameras[c]
        again: dict[int, Prediction] = {}
        for pose in (p for n, p in found if n == name):
            before = found[name, pose]
            # what was found by rows among many false dots was already searched with an adjusted lens
            if len(before.rows) >= body.known.sum() or before.method == "rows":
                continue
            prediction = _prediction(found, detections, body, orientation, name, pose, max(1.0, 3.0 * ratio))
            if prediction is not None and (
                before.method == "none" or _more_to_find(detections[name][pose], before, body, camera, prediction)
            ):
                again[pose] = prediction
        images = identify_images(
            [detections[name][pose] for pose in again],
            body,
            camera,
            predictions=[[p] for p in again.values()],
            model_error_px=max(0.5, ratio),
            search=False,
        )
        for pose, image in zip(again, images, strict=True):
            before = found[name, pose]
            if len(image.rows) > len(before.rows) or before.method == "none":
                found[name, pose] = image


def _prediction(
    found: Mapping[tuple[str, int], IdentifiedImage],
    detections: Mapping[str, Mapping[int, Detections]],
    body: Body,
    orientation: StationOrientation,
    name: str,
    pose: int,
    error_px: float,
) -> Prediction | None:
    """Where the oriented station expects the body before a camera.

    Where the images of a pose contradict one another none was oriented: then codes are believed rather than a search.
    """

    def world_T_camera(camera: str) -> Array:
        c = orientation.names.index(camera)
        return np.asarray(orientation.world_T_exterior[int(orientation.exterior_of(c, [pose])[0])])

    i = np.flatnonzero(orientation.poses == pose)
    if len(i):
        world_T_body, covariance = orientation.world_T_body[i[0]], orientation.body_covariance[i[0]]
        return Prediction(invert(world_T_camera(name)) @ world_T_body, covariance, error_px)
    for c, other in enumerate(orientation.names):
        image = found.get((other, pose))
        if other == name or image is None or image.method != "codes":
            continue
        d, usable = detections[other][pose], body.known[body.index(image.ids)]
        rows = image.rows[usable]
        covariance = d.covariance[rows] + 0.5**2 * np.eye(2)
        try:
            fit = resect(orientation.cameras[c], image.ids[usable], d.xy[rows], covariance, body)
        except RobcalError:
            continue  # too few targets or all in a line: no prediction from this camera
        frame = invert(world_T_camera(name)) @ world_T_camera(other) @ fit.camera_T_body
        return Prediction(frame, fit.covariance, error_px)
    return None


def _more_to_find(
    detections: Detections, before: IdentifiedImage, body: Body, camera: Camera, prediction: Prediction
) -> bool:
    """Whether a dot without number lies where a target that was not found should be seen."""
    missing = np.flatnonzero(body.known & ~np.isin(body.ids, before.ids))
    free = np.setdiff1d(np.arange(len(detections.xy)), before.rows)
    places, gate, _ = predict_dots(
        camera, prediction.camera_T_body, prediction.covariance, body, missing, prediction.error_px
    )
    seen = np.isfinite(places).all(axis=1)
    off = np.linalg.norm(places[seen, None] - detections.xy[free], axis=-1)
    return bool((off < gate[seen, None]).any())

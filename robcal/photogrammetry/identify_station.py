"""Identification over a whole station: images help one another through the other cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from robcal.errors import RobcalError
from robcal.imaging.detections import Detections
from robcal.photogrammetry.bodies import Body
from robcal.photogrammetry.camera import Camera
from robcal.photogrammetry.identify_targets import IdentifiedImage, Prediction, identify_targets
from robcal.photogrammetry.station import orient_station
from robcal.photogrammetry.station_network import StationMarks, StationOrientation, StationSettings
from robcal.transforms import invert


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
        for name, images in detections.items() if images
    }  # fmt: skip
    start = {n: c if (c := cameras.get(n)) is not None else Camera.from_size(*sizes[n]) for n in sizes}
    loose = {n: model_error_px if cameras.get(n) is not None else 4.0 * model_error_px for n in sizes}
    found: dict[tuple[str, int], IdentifiedImage] = {}
    for name in sizes:
        for pose in sorted(detections[name]):
            # the robot may go anywhere between two poses: the last pose is no prediction
            found[name, pose] = identify_targets(detections[name][pose], body, start[name], model_error_px=loose[name])
    _by_other_views(found, detections, body, start, loose)
    orientation = _orient(found, detections, body, cameras, sizes)
    if orientation is not None:
        _second_round(found, detections, body, orientation)
    marks = {name: _marks(name, found, detections[name]) for name in sizes}
    problems = tuple((n, p, image.reason) for (n, p), image in sorted(found.items()) if image.reason)
    return StationIdentification(marks, found, problems)


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
    marks = {name: _marks(name, found, detections[name]) for name in sizes}
    marks = {name: m for name, m in marks.items() if len(m)}
    if len(marks) == 0 or body.known.sum() < 4:
        return None
    try:
        settings = StationSettings(detect_moves=False, detect_targets=False)
        return orient_station(marks, body, cameras, sizes, settings=settings)
    except RobcalError:
        return None  # the second round is a help only; what is wrong with the station is said by its own stage


def _second_round(
    found: dict[tuple[str, int], IdentifiedImage],
    detections: Mapping[str, Mapping[int, Detections]],
    body: Body,
    orientation: StationOrientation,
) -> None:
    """Identify again with adjusted cameras and the body's pose as the other cameras (or this one) saw it."""
    at = {int(p): i for i, p in enumerate(orientation.poses)}
    ratio = max(1.0, orientation.rms_px)
    for (name, pose), before in list(found.items()):
        if name not in orientation.names or pose not in at:
            continue
        # what was found by rows among many false dots was already searched with an adjusted lens
        if len(before.rows) >= body.known.sum() or before.method == "rows":
            continue
        c = orientation.names.index(name)
        e = int(orientation.exterior_of(c, [pose])[0])
        i = at[pose]
        camera_T_body = invert(orientation.world_T_exterior[e]) @ orientation.world_T_body[i]
        prediction = Prediction(camera_T_body, orientation.body_covariance[i], max(1.0, 3.0 * ratio))
        image = identify_targets(
            detections[name][pose], body, orientation.cameras[c], predictions=[prediction],
            model_error_px=max(0.5, ratio), search=False,
        )  # fmt: skip
        if len(image.rows) > len(before.rows) or before.method == "none":
            found[name, pose] = image

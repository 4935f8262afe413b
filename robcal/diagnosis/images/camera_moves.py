"""Cameras that moved a little: found among all other causes, given an orientation of their own from there on.

The adjustment frees what is beyond doubt. A small move looks like other things (a plate that warms up, glass in front
of a camera), so the diagnosis of the images, which knows them all, decides; the station is oriented again with what it
found. With two cameras only their relative motion shows in images. The robot stood still for it: with the wrong one its
base seems to jump, so the one that leaves the smaller misfit of the robot has moved.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from robcal.diagnosis.images.diagnosis import diagnose_images
from robcal.errors import RobcalError
from robcal.photogrammetry.station.contradictions import CAMERA_MOVED
from robcal.photogrammetry.station.network import StationCause, StationOrientation, StationSettings, movement
from robcal.physics.images.data import ImageData

MOST = 3
BEYOND_DOUBT = 1e4
"""Chi-square of a movement from which nothing else can be meant: a plate that grows reaches some thousands."""
DECIDED = 12.0
"""Difference of the robot's misfits (chi-square) from which the other camera is excluded: odds of 400."""
Orient = Callable[[StationSettings], StationOrientation]
Misfit = Callable[[StationOrientation], tuple[float, int] | None]
"""Whitened sum of squares that the identified robot leaves, and its redundancy; None where it cannot be found."""


def with_small_moves(
    orientation: StationOrientation, orient: Orient, data: Callable[[StationOrientation], ImageData]
) -> tuple[StationOrientation, Orient]:
    """The station with an epoch for each camera movement that the diagnosis of the images finds.

    Also returns how to orient it again: moves that the adjustment took for such and the diagnosis, which knows the
    alternatives, for something else are not looked for any more.

    Parameters
    ----------
    orientation : with the default settings. orient : orientation with given settings.
    data : the diagnosis' view of an orientation.
    """
    if len(orientation.names) < 2:
        return orientation, orient
    moved = [e for e in orientation.evidence if e.kind.moves == "camera"]
    if moved and max(e.statistic for e in moved) < BEYOND_DOUBT:
        at_rest = orient(StationSettings(detect_moves=False))
        causes = {f.kind for f in diagnose_images(data(at_rest)).findings}
        if causes and CAMERA_MOVED not in causes:
            return at_rest, lambda settings: orient(replace(settings, detect_moves=False))
    for _ in range(MOST):
        view = data(orientation)
        found = next((f for f in diagnose_images(view).findings if f.kind == CAMERA_MOVED), None)
        if found is None:
            break
        pose = int(orientation.poses[view.image_names.index(str(found.parameters["pose"]))])
        try:
            orientation = _oriented(orient, orientation, _with(epochs_of(orientation), found.where, pose))
        except RobcalError:  # an epoch with too few marks cannot be adjusted
            break
    return orientation, orient


def epochs_of(orientation: StationOrientation) -> dict[str, tuple[int, ...]]:
    """Camera -> poses from which on it stands elsewhere."""
    return {
        name: tuple(int(p) for p in sorted(orientation.exterior_first_pose[orientation.exterior_camera == c])[1:])
        for c, name in enumerate(orientation.names)
    }


def _with(epochs: Mapping[str, tuple[int, ...]], camera: str, pose: int) -> dict[str, tuple[int, ...]]:
    return {name: tuple(sorted({*poses, pose})) if name == camera else poses for name, poses in epochs.items()}


def _oriented(orient: Orient, before: StationOrientation, epochs: Mapping[str, tuple[int, ...]]) -> StationOrientation:
    """The station oriented with known epochs; they are evidence like the ones that the adjustment finds itself."""
    after = orient(StationSettings(epochs={name: poses for name, poses in epochs.items() if poses}))
    reported = {(e.where, e.pose) for e in after.evidence if e.kind.moves == "camera"}
    known = [
        moved_evidence(after, name, pose)
        for name, poses in epochs.items()
        for pose in poses
        if (name, pose) not in reported
    ]
    return replace(after, evidence=(*known, *after.evidence))


def moved_evidence(orientation: StationOrientation, camera: str, pose: int) -> StationCause:
    """How a camera stands from a pose on against before, from its adjusted exterior orientations."""
    shift, covariance = orientation.movement(camera, pose)
    statistic = float(shift @ np.linalg.pinv(covariance, rcond=1e-9, hermitian=True) @ shift)
    return StationCause(
        CAMERA_MOVED, camera, None, pose, shift, covariance, statistic, 6, movement(camera, pose, shift)
    )


def which_moved(orientation: StationOrientation, orient: Orient, misfit_of: Misfit) -> StationOrientation:
    """Of two cameras the one that really moved, as the robot tells; `StationCause.alone` where it can.

    Each movement is tried on both cameras, one after the other; ``misfit_of`` is what the robot leaves with a station.
    """
    if len(orientation.names) != 2:
        return orientation
    misfit = misfit_of(orientation)
    for item in [e for e in orientation.evidence if e.kind.moves == "camera"]:
        if misfit is None or item.pose is None:
            break
        epochs = epochs_of(orientation)
        other = next(name for name in orientation.names if name != item.where)
        own = tuple(p for p in epochs[item.where] if p != item.pose)
        try:
            second = _oriented(orient, orientation, _with({**epochs, item.where: own}, other, item.pose))
        except RobcalError:
            continue
        rival = None if item.pose in epochs_of(second)[item.where] else misfit_of(second)
        if rival is None:  # both of them moved there
            continue
        best = min(misfit, rival)
        alone = abs(rival[0] - misfit[0]) > DECIDED * max(1.0, best[0] / max(best[1], 1))
        better, name = (second, other) if rival < misfit else (orientation, item.where)
        misfit = best
        reported = tuple(
            replace(e, alone=e.alone or (alone and (e.where, e.pose) == (name, item.pose))) for e in better.evidence
        )
        orientation = replace(better, evidence=reported)
    return orientation

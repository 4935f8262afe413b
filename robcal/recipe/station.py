"""The station from identified marks: what its images show of themselves is corrected before the robot is looked at."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from robcal.diagnosis.images.camera_moves import which_moved, with_small_moves
from robcal.diagnosis.images.diagnosis import ImageFinding
from robcal.diagnosis.images.light_lag import with_dot_sizes, without_lag
from robcal.diagnosis.images.station import station_data
from robcal.errors import InvalidInput
from robcal.files.measurement_tables import MarksTable
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.station.network import StationMarks, StationOrientation, StationSettings
from robcal.photogrammetry.station.orientation import orient_station
from robcal.photogrammetry.station.seen_normals import Ellipses, needs_normals, with_seen_normals
from robcal.physics.images.data import ImageData
from robcal.transforms import Array

DEFAULT = StationSettings()
Marks = Mapping[str, StationMarks]
Misfit = Callable[[StationOrientation, Marks], tuple[float, int] | None]
"""Whitened sum of squares that the identified robot leaves, and its redundancy; None where it cannot be found."""


@dataclass(frozen=True)
class StationImages:
    """What the cameras of a station saw of the body that the robot carries.

    Attributes
    ----------
    poses : names of the poses. body : as it is known before.
    marks : camera -> identified marks; shapes : camera -> their ellipses and light, none for marks of other programs.
    start : camera -> interior orientation from a file; stated : camera -> world_T_camera (4, 4) from a file.
    sizes : camera -> width and height in px. covariates : (n,) by pose: `temp_<place>_c`, `hours`.
    """

    poses: tuple[str, ...]
    body: Body
    marks: Marks = field(repr=False)
    shapes: Mapping[str, Ellipses] = field(repr=False)
    start: Mapping[str, Camera | None]
    stated: Mapping[str, Array] = field(default_factory=dict)
    sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    covariates: Mapping[str, Array] = field(default_factory=dict)

    def orient(self, settings: StationSettings = DEFAULT) -> StationOrientation:
        """The station adjusted with these marks and this body."""
        start = {name: self.start[name] for name in self.marks}
        return orient_station(self.marks, self.body, start, self.sizes, self.stated, settings)

    def data(self, orientation: StationOrientation, given: Body) -> ImageData:
        """The diagnosis' view of an orientation; `given`: the body as it is known before."""
        view = station_data(orientation, self.poses, given, dict(self.start), self.covariates)
        return replace(view, light=light_of(orientation, self.marks, self.shapes))


@dataclass(frozen=True)
class OrientedStation:
    """An oriented station, the marks it was oriented with, and the findings of its images that these are free of."""

    orientation: StationOrientation
    marks: Marks
    corrected: tuple[ImageFinding, ...] = ()


def orient_images(images: StationImages, diagnose: bool, misfit_of: Misfit | None) -> OrientedStation:
    """Orient a station.

    Parameters
    ----------
    diagnose : whether causes in the images (sizes of dots, trailing light, moved cameras) are looked for and corrected.
    misfit_of : what the robot leaves with a station and its marks; tells which of two cameras moved. None: no robot.

    Raises
    ------
    InvalidInput, DegenerateGeometry : the marks do not carry an orientation.
    """
    given = images.body
    if needs_normals(given):
        at_rest = images.orient(StationSettings(detect_moves=False))
        images = replace(images, body=with_seen_normals(given, at_rest, images.marks, images.shapes))
    if not diagnose:
        return OrientedStation(images.orient(), images.marks)
    before = images
    body, corrected = with_dot_sizes(images.body, lambda: before.data(before.orient(), given))
    images = replace(images, body=body)
    orientation, sized = images.orient(), images
    marks, lags = without_lag(images.marks, images.shapes, lambda: sized.data(orientation, given))
    free = replace(images, marks=marks)
    first = free.orient() if lags else orientation
    found, again = with_small_moves(first, free.orient, lambda tried: free.data(tried, given))
    if misfit_of is not None:
        found = which_moved(found, again, lambda tried: misfit_of(tried, marks))
    return OrientedStation(found, marks, (*corrected, *lags))


def marks_of_table(table: MarksTable, body: Body, place: Mapping[str, int]) -> StationMarks:
    """Marks of another program: those of targets of the body; ``place`` are the pose numbers by image.

    Raises
    ------
    InvalidInput : none of its targets is on the body.
    """
    listed = body.index(table.target) >= 0
    if not listed.any():
        raise InvalidInput(f"{table.path}: none of its targets is on body '{body.name}': check the ids")
    covariance = table.sigma[listed][:, None, None] ** 2 * np.eye(2)
    pose = np.array([place[image] for image in table.image], dtype=np.int64)
    return StationMarks(pose[listed], table.target[listed], table.xy[listed], covariance)


def light_of(
    orientation: StationOrientation, marks: Mapping[str, StationMarks], shapes: Mapping[str, Ellipses]
) -> Array | None:
    """Light (m,) of the marks that a station was adjusted with; None where no images were read."""
    if not shapes:
        return None
    known = {
        (name, int(pose), int(target)): float(light)
        for name, shape in shapes.items()
        for pose, target, light in zip(marks[name].pose, marks[name].target, shape.light, strict=True)
    }
    m = orientation.marks
    keys = zip(m.camera, orientation.poses[m.pose], orientation.body.ids[m.target], strict=True)
    return np.array([known.get((orientation.names[c], int(p), int(t)), np.nan) for c, p, t in keys])

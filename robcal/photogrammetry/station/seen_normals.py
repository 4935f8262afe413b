"""Directions of a body's dots from the ellipses that a station's images show, where the body's shape does not
determine them.

Dots at different heights on a plate, or on facets, have coordinates but no known normals. Without them the eccentricity
of a dot's image cannot be modelled, though in many poses the ellipses show plainly how each dot leans.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from robcal.imaging.detections import Detections
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.discs import discs_from_ellipses
from robcal.photogrammetry.station.network import StationMarks, StationOrientation
from robcal.transforms import Array, invert

SURE = np.radians(2.0)
"""Standard deviation from which a direction is believed."""


@dataclass(frozen=True)
class Ellipses:
    """Shapes of one camera's marks: ``semi_axes`` (m, 2) px, major first, ``angle`` (m,) rad; ``light`` (m,) by the
    largest number of the image's type; NaN where unknown."""

    semi_axes: Array
    angle: Array
    light: Array


def ellipses_of(marks: StationMarks, detections: Mapping[int, Detections]) -> Ellipses:
    """The ellipses of identified marks, from the detections (by pose) that they were taken from."""
    axes, angle = np.full((len(marks), 2), np.nan), np.full(len(marks), np.nan)
    contrast = np.full(len(marks), np.nan)
    for pose, found in detections.items():
        row_of = {tuple(xy): row for row, xy in enumerate(found.xy.tolist())}
        for i in np.flatnonzero(marks.pose == pose):
            row = row_of.get(tuple(marks.xy[i].tolist()))
            if row is not None:
                axes[i], angle[i], contrast[i] = found.semi_axes[row], found.angle[row], abs(found.contrast[row])
    top = 255.0 if not np.nanmax(contrast, initial=0.0) > 255.0 else 65535.0
    return Ellipses(axes, angle, contrast / top)


def needs_normals(body: Body) -> bool:
    """Whether the directions of some dots with coordinates are open."""
    dots = body.known & np.array([code != "corner" for code in body.codes], dtype=bool)
    return body.normals is None and bool(np.isnan(body.estimated_normals()[dots]).any())


def with_seen_normals(
    body: Body, orientation: StationOrientation, marks: Mapping[str, StationMarks], ellipses: Mapping[str, Ellipses]
) -> Body:
    """The body with outward normals from the ellipses of all cameras, where its shape does not determine them.

    Weakness: the mean of the cameras' directions, each weighted by its own scatter; poses that turn the plate little
    before the cameras leave directions open.
    """
    sum_of = np.zeros((len(body), 3))
    weight = np.zeros(len(body))
    for c, name in enumerate(orientation.names):
        if name not in ellipses:
            continue
        m, shape = marks[name], ellipses[name]
        at = np.flatnonzero(np.isin(m.pose, orientation.poses) & body.known[body.index(m.target)])
        exterior = orientation.world_T_exterior[orientation.exterior_of(c, orientation.poses)]
        camera_T_body = invert(exterior) @ orientation.world_T_body
        image, target = np.searchsorted(orientation.poses, m.pose[at]), body.index(m.target[at])
        points = np.nan_to_num(body.points)
        seen = discs_from_ellipses(
            orientation.cameras[c], camera_T_body, points, image, target, shape.semi_axes[at], shape.angle[at]
        )
        determined = np.isfinite(seen.sigma)
        sum_of[determined] += seen.normal[determined] / seen.sigma[determined, None] ** 2
        weight[determined] += seen.sigma[determined] ** -2
    known = weight > SURE**-2
    length = np.linalg.norm(sum_of, axis=1)
    known &= length > 0.9 * weight  # the cameras agree
    normals = body.estimated_normals()
    open_ = known & np.isnan(normals).any(axis=1)
    if not open_.any():
        return body
    normals[open_] = sum_of[open_] / length[open_, None]
    return replace(body, normals=normals)

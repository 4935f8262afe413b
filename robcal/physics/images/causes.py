"""Causes that show in images: lens terms, a camera that moved, eccentricity of dots, refraction, displaced targets.

Each gives the displacement (m, 2, q) in px of all marks per unit of its parameters.
"""

from collections.abc import Iterator

import numpy as np

from robcal.photogrammetry.core.camera import project_with_jacobians
from robcal.photogrammetry.core.eccentricity import centre_shift
from robcal.photogrammetry.station.contradictions import (
    CAMERA_MOVED,
    LENS_AFFINITY,
    LENS_RADIAL,
    LENS_TANGENTIAL,
    TARGET_SHIFTED,
)
from robcal.physics.cause import DEG, Array, Constants
from robcal.physics.images.cause import CENTROID_BIAS, ECCENTRICITY, UNKNOWN_FIELD, ImageCause, only
from robcal.physics.images.data import ImageData
from robcal.physics.images.refraction import refraction_causes
from robcal.physics.measuring import BODY_THERMAL_GROWTH, SCALE_DRIFT

FIELD_DEGREE = 5
MOST_CHANGE_POINTS = 40
LEAST_LIGHT = 0.02
"""Scatter of the dots' light below which nothing can be said of its influence."""


def image_causes(data: ImageData, moves: bool = True) -> Iterator[ImageCause]:
    """All causes that these images may show and that their model leaves out."""
    for c, name in enumerate(data.names):
        rows = data.camera == c
        if np.any(rows):
            yield from _lens(data, c, name, rows)
            yield from refraction_causes(data, c, name, rows)
            yield from _bias(data, name, rows)
            yield from _lag(data, name, rows)
            yield _field(data, c, name, rows)
            if moves and data.by_exterior is not None:
                yield from _moves(data, name, rows)
    yield from _eccentricity(data)
    if data.by_target is not None:
        yield from _targets(data, data.by_target)
        yield from _growth(data, data.by_target)


def _lens(data: ImageData, c: int, name: str, rows: Array) -> Iterator[ImageCause]:
    _, _, by = project_with_jacobians(data.cameras[c], data.p_camera)
    free = data.free[c]
    radial = [i for i, n in ((4, "k1"), (5, "k2"), (8, "k3")) if n not in free]
    labels = {4: "k1", 5: "k2", 8: "k3"}
    if len(radial) == 3:
        yield ImageCause(
            LENS_RADIAL,
            name,
            None,
            only(rows, by[:, :, radial]),
            np.array([0.1, 0.1, 0.1]),
            lambda v, c: {labels[i]: float(x) for i, x in zip(radial, v, strict=True)},
        )
    if not {"p1", "p2"} & free:
        yield ImageCause(
            LENS_TANGENTIAL,
            name,
            None,
            only(rows, by[:, :, 6:8]),
            np.array([1e-3, 1e-3]),
            lambda v, c: {"p1": float(v[0]), "p2": float(v[1])},
        )
    if not ({"affinity"} & free or ({"fx", "fy"} <= free - {"f_only"} and "f_only" not in free)):
        f = data.cameras[c].fy
        yield ImageCause(
            LENS_AFFINITY,
            name,
            None,
            only(rows, by[:, :, 1:2]),
            np.array([1e-3 * f]),
            lambda v, c: {"fy_minus_fx_px": float(v[0])},
        )


def _eccentricity(data: ImageData) -> Iterator[ImageCause]:
    """Dots whose size the model does not know: the same dots in the images of all cameras.

    Weakness: one diameter for all of them.
    """
    if not data.dots or np.any(data.radii > 0):
        return
    radius = 5e-3
    shift = np.zeros_like(data.xy)
    seen = np.isfinite(data.normal_camera).all(axis=1)
    for c in np.unique(data.camera[seen]):
        rows = seen & (data.camera == c)
        shift[rows] = centre_shift(
            data.cameras[c], data.p_camera[rows], data.normal_camera[rows], np.full(int(rows.sum()), radius)
        )
    names = tuple(name for c, name in enumerate(data.names) if np.any(shift[data.camera == c]))
    if not names:
        return
    yield ImageCause(
        ECCENTRICITY,
        names[0] if len(names) == 1 else "station",
        None,
        shift[:, :, None] / radius**2,
        np.array([1e-4]),
        lambda v, c: {"diameter_mm": 2e3 * float(np.sqrt(max(v[0], 0.0)))},
        bends=True,
        plausible=lambda v: float(v[0]) > 0,
        places=names,
    )


def _bias(data: ImageData, name: str, rows: Array) -> Iterator[ImageCause]:
    """Centres displaced along the direction in which a dot is tilted: lit unevenly, or glossy on one side.

    Weakness: a displacement that is the same for all dots, or goes with their size alone, is taken over by the
    principal point and the camera's place and cannot be seen.
    """
    tilt = data.normal_camera[:, :2]
    if not data.dots or not np.any(np.isfinite(tilt[rows])):
        return
    yield ImageCause(
        CENTROID_BIAS,
        name,
        None,
        only(rows, np.nan_to_num(tilt)[:, :, None]),
        np.array([0.1]),
        lambda v, c: {"px": float(v[0])},
        "Centres of tilted dots in {where} are displaced along their tilt, by {px:.3f} px at a right angle",
        weight=0.3,
        bends=True,
    )


def _lag(data: ImageData, name: str, rows: Array) -> Iterator[ImageCause]:
    """Centres displaced by so much times their light: charge that lags behind on read-out, light that spills over.

    Weakness: only what differs between the marks of an image, or from image to image, can be seen.
    """
    if data.light is None or not data.dots:
        return
    light = data.light[rows]
    if np.count_nonzero(np.isfinite(light)) < 10 or np.nanstd(light) < LEAST_LIGHT:
        return
    columns = np.nan_to_num(data.light)[:, None, None] * np.eye(2)
    yield ImageCause(
        CENTROID_BIAS,
        name,
        None,
        only(rows, columns),
        np.array([0.2, 0.2]),
        lambda v, c: {"px": float(np.hypot(*v)), "by_light_px": [float(x) for x in v]},
        "Centres of bright dots in {where} lag behind their light, by {px:.3f} px where a dot is as bright as can be",
        weight=0.3,
        bends=True,
    )


def _field(data: ImageData, c: int, name: str, rows: Array) -> ImageCause:
    """Any smooth displacement field over the image, for what has no name."""
    camera = data.cameras[c]
    half = 0.5 * max(camera.width, camera.height)
    x, y = (data.xy[:, 0] - camera.cx) / half, (data.xy[:, 1] - camera.cy) / half
    powers = [(i, j) for i in range(FIELD_DEGREE + 1) for j in range(FIELD_DEGREE + 1 - i)]
    monomials = np.stack([x**i * y**j for i, j in powers], axis=1)
    columns = np.zeros((len(x), 2, 2 * len(powers)))
    columns[:, 0, : len(powers)] = monomials
    columns[:, 1, len(powers) :] = monomials

    def report(v: Array, c: Constants) -> dict[str, object]:
        terms = [
            f"{axis} += {value:.4g} x^{i} y^{j}"
            for axis, part in (("dx", v[: len(powers)]), ("dy", v[len(powers) :]))
            for (i, j), value in zip(powers, part, strict=True)
            if abs(value) > 1e-4
        ]
        return {"term": {"variables": ["x_px", "y_px"], "kind": "formula", "formula": "; ".join(terms)}}

    return ImageCause(
        UNKNOWN_FIELD,
        name,
        None,
        only(rows, columns),
        np.full(columns.shape[2], 0.1),
        report,
        weight=0.1,
        least_gain=0.15,
    )


def _moves(data: ImageData, name: str, rows: Array) -> Iterator[ImageCause]:
    by = data.by_exterior
    first = np.unique(data.image[rows])
    if by is None or len(first) < 6:
        return
    # neighbouring change points look alike; the chosen one is refined afterwards
    stride = int(np.ceil(len(first) / MOST_CHANGE_POINTS))
    for pose in first[2:-1:stride]:
        yield move_cause(data, by, name, rows, int(pose), stride / len(first))


def neighbouring_moves(data: ImageData, cause: ImageCause) -> Iterator[ImageCause]:
    """The change points that :func:`image_causes` skipped around a found one."""
    by, rows = data.by_exterior, data.camera == data.names.index(cause.where)
    first = np.unique(data.image[rows])
    stride = int(np.ceil(len(first) / MOST_CHANGE_POINTS))
    if by is None or cause.pose is None or stride == 1:
        return
    at = int(np.searchsorted(first, cause.pose))
    for pose in first[max(1, at - stride + 1) : min(len(first) - 1, at + stride)]:
        yield move_cause(data, by, cause.where, rows, int(pose), cause.weight)


def move_cause(data: ImageData, by: Array, name: str, rows: Array, pose: int, weight: float) -> ImageCause:
    """A camera that stands elsewhere from an image on."""
    label = data.image_names[pose]
    return ImageCause(
        CAMERA_MOVED,
        name,
        None,
        only(rows & (data.image >= pose), by),
        np.array([2e-4, 2e-4, 2e-4, 1e-4, 1e-4, 1e-4]),
        lambda v, c: {
            "pose": label,
            "shift_mm": [1e3 * float(x) for x in v[:3]],
            "turn_deg": [DEG * float(x) for x in v[3:]],
        },
        weight=weight,
        pose=pose,
        once=False,
    )


def _targets(data: ImageData, by_target: Array) -> Iterator[ImageCause]:
    present = np.unique(data.target)
    for target in present:
        yield ImageCause(
            TARGET_SHIFTED,
            str(int(target)),
            None,
            only(data.target == target, by_target),
            np.array([1e-4, 1e-4, 1e-4]),
            lambda v, c: {"shift_mm": [1e3 * float(x) for x in v]},
            weight=1.0 / len(present),
        )


def _growth(data: ImageData, by_target: Array) -> Iterator[ImageCause]:
    """A body that grows with a temperature, or a scale that drifts with time: the same in the images of a station."""
    radial = by_target @ data.p_body[:, :, None]
    warm = {name: v for name, v in data.covariates.items() if name.startswith("temp_") and np.ptp(v) > 0}
    for name, change in warm.items():

        def report(v: Array, c: Constants, name: str = name) -> dict[str, object]:
            return {"um_per_m_K": 1e6 * float(v[0]), "covariate": name}

        yield ImageCause(
            BODY_THERMAL_GROWTH,
            data.body,
            None,
            radial * change[:, None, None],
            np.array([1e-5]),
            report,
            "Body {where} grows by {um_per_m_K:.1f} um per metre and kelvin of {covariate}",
            weight=0.5 / len(warm),
            twins=((SCALE_DRIFT, "station"),),
        )
    hours = data.covariates.get("hours")
    if hours is not None and np.ptp(hours) > 0:
        yield ImageCause(
            SCALE_DRIFT,
            "station",
            None,
            radial * hours[:, None, None],
            np.array([50e-6 / float(np.max(np.abs(hours)))]),
            lambda v, c: {"ppm_per_h": 1e6 * float(v[0])},
            "The scale of the station drifts by {ppm_per_h:.1f} ppm an hour",
            weight=0.25,
            twins=((BODY_THERMAL_GROWTH, data.body),),
        )

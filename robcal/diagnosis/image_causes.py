"""Causes that show in images: lens terms, a camera that moved, eccentricity of dots, refraction, displaced targets.

Each gives the displacement (m, 2, q) in px of all marks per unit of its parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from robcal.diagnosis.image_data import ImageData
from robcal.photogrammetry.camera import project_with_jacobians
from robcal.photogrammetry.eccentricity import centre_shift
from robcal.physics.family import Array

DEG = float(np.degrees(1.0))
FIELD_DEGREE = 5


@dataclass(frozen=True)
class ImageCause:
    """A candidate: where it acts, its columns, the typical size of its parameters, and how they are told.

    `plausible` refuses estimates that physics forbids; `least_gain` is the share by which the prediction of marks must
    improve for the cause to be worth a name.
    """

    cause: str
    stage: str
    where: str
    direction: str | None
    columns: Array
    sizes: Array
    report: Callable[[Array], dict[str, object]]
    sentence: str
    weight: float = 1.0
    plausible: Callable[[Array], bool] = lambda values: True
    least_gain: float = 0.003


def image_causes(data: ImageData, moves: bool = True) -> Iterator[ImageCause]:
    """All causes that these images may show and that their model leaves out."""
    for c, name in enumerate(data.names):
        rows = data.camera == c
        if np.any(rows):
            yield from _lens(data, c, name, rows)
            yield from _refraction(data, c, name, rows)
            yield from _eccentricity(data, c, name, rows)
            yield _field(data, c, name, rows)
            if moves and data.by_exterior is not None:
                yield from _moves(data, name, rows)
    if data.by_target is not None:
        yield from _targets(data, data.by_target)


def _only(rows: Array, values: Array) -> Array:
    return np.where(rows[:, None, None], values, 0.0)


def _lens(data: ImageData, c: int, name: str, rows: Array) -> Iterator[ImageCause]:
    _, _, by = project_with_jacobians(data.cameras[c], data.p_camera)
    free = data.free[c]
    radial = [i for i, n in ((4, "k1"), (5, "k2"), (8, "k3")) if n not in free]
    labels = {4: "k1", 5: "k2", 8: "k3"}
    if len(radial) == 3:
        yield ImageCause(
            "lens_radial",
            "camera",
            name,
            None,
            _only(rows, by[:, :, radial]),
            np.array([0.1, 0.1, 0.1]),
            lambda v: {labels[i]: float(x) for i, x in zip(radial, v, strict=True)},
            "The lens of camera {where} has radial distortion that its file leaves out",
        )
    if not {"p1", "p2"} & free:
        yield ImageCause(
            "lens_tangential",
            "camera",
            name,
            None,
            _only(rows, by[:, :, 6:8]),
            np.array([1e-3, 1e-3]),
            lambda v: {"p1": float(v[0]), "p2": float(v[1])},
            "The lens of camera {where} has tangential distortion that its file leaves out",
        )
    if not ({"affinity"} & free or ({"fx", "fy"} <= free - {"f_only"} and "f_only" not in free)):
        f = data.cameras[c].fy
        yield ImageCause(
            "lens_affinity",
            "camera",
            name,
            None,
            _only(rows, by[:, :, 1:2]),
            np.array([1e-3 * f]),
            lambda v: {"fy_minus_fx_px": float(v[0])},
            "The pixels of camera {where} are not square: fy differs from fx by {fy_minus_fx_px:.2f} px",
        )


def _refraction(data: ImageData, c: int, name: str, rows: Array) -> Iterator[ImageCause]:
    """Behind a flat boundary of air to a medium, depths along its normal shrink by 1 - 1/index (near the normal).

    What shows beside focal length and distance is the shrinking of depth differences. The normal is taken along the
    camera's axis or an axis of the body.
    """
    _, by_point, _ = project_with_jacobians(data.cameras[c], data.p_camera)
    body_axes = data.camera_R_body.swapaxes(1, 2)
    normals = [np.broadcast_to([0.0, 0.0, 1.0], data.p_camera.shape), *(body_axes[:, k] for k in range(3))]
    for normal in normals:
        depth = np.einsum("mi,mi->m", normal, data.p_camera)
        depth = depth - np.mean(depth[rows])
        yield ImageCause(
            "refraction",
            "camera",
            name,
            None,
            _only(rows, -by_point @ (normal * depth[:, None])[:, :, None]),
            np.array([0.2]),
            lambda v: {"index": float(1.0 / max(1.0 - v[0], 1e-3))},
            "Camera {where} looks through a boundary of media (apparent index {index:.3f})",
            weight=0.25,
            plausible=lambda v: 0.03 < abs(float(v[0])) < 0.6,
        )


def _eccentricity(data: ImageData, c: int, name: str, rows: Array) -> Iterator[ImageCause]:
    if np.any(data.radii[rows] > 0) or not np.any(np.isfinite(data.normal_camera[rows])):
        return
    radius = 5e-3
    shift = centre_shift(data.cameras[c], data.p_camera, data.normal_camera, np.where(rows, radius, 0.0))
    yield ImageCause(
        "ellipse_eccentricity",
        "image",
        name,
        None,
        shift[:, :, None] / radius**2,
        np.array([1e-4]),
        lambda v: {"diameter_mm": 2e3 * float(np.sqrt(max(v[0], 0.0)))},
        "Dots seen obliquely by {where} show off their centres as dots of {diameter_mm:.1f} mm do",
        plausible=lambda v: float(v[0]) > 0,
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

    def report(v: Array) -> dict[str, object]:
        terms = [
            f"{axis} += {value:.4g} x^{i} y^{j}"
            for axis, part in (("dx", v[: len(powers)]), ("dy", v[len(powers) :]))
            for (i, j), value in zip(powers, part, strict=True)
            if abs(value) > 1e-4
        ]
        return {"term": {"variables": ["x_px", "y_px"], "kind": "formula", "formula": "; ".join(terms)}}

    return ImageCause(
        "unknown",
        "camera",
        name,
        None,
        _only(rows, columns),
        np.full(columns.shape[2], 0.1),
        report,
        "The images of {where} are bent in a manner that no lens model of the library describes",
        weight=0.1,
        least_gain=0.15,
    )


def _moves(data: ImageData, name: str, rows: Array) -> Iterator[ImageCause]:
    by = data.by_exterior
    first = np.unique(data.image[rows])
    if by is None or len(first) < 6:
        return
    for pose in first[2:-2]:

        def report(v: Array, label: str = data.image_names[int(pose)]) -> dict[str, object]:
            return {
                "pose": label,
                "shift_mm": [1e3 * float(x) for x in v[:3]],
                "turn_deg": [DEG * float(x) for x in v[3:]],
            }

        yield ImageCause(
            "camera_moved",
            "camera",
            name,
            None,
            _only(rows & (data.image >= pose), by),
            np.array([1e-3, 1e-3, 1e-3, 5e-4, 5e-4, 5e-4]),
            report,
            "Camera {where} moved before pose {pose}",
            least_gain=0.01,
            weight=1.0 / (len(first) - 4),
        )


def _targets(data: ImageData, by_target: Array) -> Iterator[ImageCause]:
    present = np.unique(data.target)
    for target in present:
        yield ImageCause(
            "target_shifted",
            "body",
            str(int(target)),
            None,
            _only(data.target == target, by_target),
            np.array([5e-4, 5e-4, 5e-4]),
            lambda v: {"shift_mm": [1e3 * float(x) for x in v]},
            "Target {where} sits at another place than its file says, by {shift_mm} mm",
            weight=1.0 / len(present),
        )

"""Image residuals of a survey or station as one linear problem: what its unknowns absorb, geometry of the marks."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from robcal.photogrammetry.bundle.operator import NetworkOperator
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.eccentricity import body_normals
from robcal.photogrammetry.core.network import CameraNetwork, Lengths
from robcal.physics.cause import Array
from robcal.transforms import transform

LENS_TERMS = frozenset({"k1", "k2", "k3", "p1", "p2", "affinity"})
"""Terms of the interior orientation that a camera file may lack."""


@dataclass(frozen=True)
class ImageData:
    """Marks of all images with their residuals.

    Rows of whitened vectors are x and y of each mark, then (of a station) those of weighted observations of unknowns;
    so `remove` is an orthogonal projection.

    Attributes
    ----------
    names : of the cameras. cameras : their interior orientation.
    camera, image, target : (m,) indices; `image` is the station of a survey or the pose of a station; `target` the id.
    p_camera : (m, 3) target in the camera frame; camera_R_body : (m, 3, 3). normal_camera : (m, 3), NaN if unknown.
    xy : (m, 2) px. residual : (r,) whitened, unit variance expected. redundancy : (m, 2) numbers of the marks.
    freedom : redundancy of the whole. whiten : displacements (m, 2, q) px to (r, q). remove : projection (r, q).
    by_exterior : (m, 2, 6) px by the camera's own exterior orientation, None for a survey.
    by_target : (m, 2, 3) px by the target's body coordinates, None where they are plain unknowns.
    p_body : (m, 3) the targets about their centroid. body : its name.
    free : per camera the numbers of the interior orientation whose lack is no cause: adjusted ones, and all where no
        file states any (`f_only`: fx and fy change alike).
    radii : (m,) m of the dots as modelled, 0 where the eccentricity is not. dots : whether the targets are round dots.
    sigma_px : typical standard deviation of a coordinate. light : (m,) of the dots, 1 at the sensor's largest number;
        NaN where unknown.
    covariates : per mark, change since the first pose: `temp_<place>_c` in K, `hours` in h.
    inflation : cause -> factor by which the scores of such candidates scatter more than the marks' noise says.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    camera: Array
    image: Array
    target: Array
    p_camera: Array
    camera_R_body: Array
    normal_camera: Array
    xy: Array
    residual: Array
    redundancy: Array
    freedom: int
    whiten: Callable[[Array], Array]
    remove: Callable[[Array], Array]
    by_exterior: Array | None
    by_target: Array | None
    p_body: Array
    body: str
    free: tuple[frozenset[str], ...]
    radii: Array
    sigma_px: float
    image_names: tuple[str, ...]
    dots: bool = True
    covariates: Mapping[str, Array] = field(default_factory=dict)
    inflation: Mapping[str, float] = field(default_factory=dict)
    light: Array | None = None


def survey_data(
    network: CameraNetwork, lengths: Lengths | None, camera_name: str, body: str = "body", *, dots: bool = True
) -> ImageData:
    """The images of a finished survey."""
    operator = NetworkOperator(network, lengths)
    marks = network.marks
    T = network.camera_T_body[marks.image]
    normals = network.normals
    if not np.all(np.isfinite(normals)):
        normals = body_normals(network.points)
    free = {part for name in network.free_intrinsics for part in (("fx", "fy") if name == "f" else (name,))}
    if "f" in network.free_intrinsics:
        free.add("f_only")
    white = operator.whiten(np.broadcast_to(np.eye(2), (len(marks), 2, 2)))
    return ImageData(
        names=(camera_name,),
        cameras=(network.camera,),
        camera=np.zeros(len(marks), dtype=int),
        image=marks.image,
        target=network.ids[marks.target],
        p_camera=transform(T, network.points[marks.target]),
        camera_R_body=T[:, :3, :3],
        normal_camera=np.einsum("mij,mj->mi", T[:, :3, :3], normals[marks.target]),
        xy=marks.xy,
        residual=operator.residuals,
        redundancy=network.redundancy,
        freedom=network.redundancy_total,
        whiten=operator.whiten,
        remove=operator.project_out,
        by_exterior=None,
        by_target=None,
        p_body=network.points[marks.target] - network.points.mean(axis=0),
        body=body,
        free=(frozenset(free),),
        radii=network.radii[marks.target],
        sigma_px=float(1.0 / np.sqrt(np.mean(white**2) * 2.0)),
        image_names=network.image_names,
        dots=dots,
    )

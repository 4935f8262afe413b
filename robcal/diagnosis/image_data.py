"""Image residuals of a survey or station as one linear problem: what its unknowns absorb, geometry of the marks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from robcal.photogrammetry.bundle_operator import NetworkOperator
from robcal.photogrammetry.camera import Camera
from robcal.photogrammetry.eccentricity import body_normals
from robcal.photogrammetry.network import CameraNetwork, Lengths
from robcal.photogrammetry.station_adjustment import global_columns
from robcal.photogrammetry.station_network import StationOrientation
from robcal.physics.family import Array
from robcal.transforms import invert, transform


@dataclass(frozen=True)
class ImageData:
    """Marks of all images with their residuals; rows of whitened vectors are x and y of each mark, (2m,).

    Attributes
    ----------
    names : of the cameras. cameras : their interior orientation. sizes : (c, 2) px.
    camera, image, target : (m,) indices; `image` is the station of a survey or the pose of a station.
    p_camera : (m, 3) target in the camera frame; camera_R_body : (m, 3, 3). normal_camera : (m, 3), NaN if unknown.
    xy : (m, 2) px. residual : (2m,) whitened, unit variance expected. redundancy : (m, 2) numbers of the marks.
    freedom : redundancy of the whole. whiten : displacements (m, 2, q) px to (2m, q). remove : projection.
    by_exterior : (m, 2, 6) px by the camera's own exterior orientation, None for a survey.
    by_target : (m, 2, 3) px by the target's body coordinates, None where they are unknowns.
    free : names of the numbers of the interior orientation that are adjusted, per camera.
    radii : (m,) m of the dots as modelled, 0 where the eccentricity is not.
    sigma_px : typical standard deviation of a coordinate.
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
    free: tuple[frozenset[str], ...]
    radii: Array
    sigma_px: float
    image_names: tuple[str, ...]

    @property
    def spread(self) -> float:
        """Pixels that stand for one unit of whitened residual, in the mean."""
        return self.sigma_px


def survey_data(network: CameraNetwork, lengths: Lengths | None, camera_name: str) -> ImageData:
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
        (camera_name,),
        (network.camera,),
        np.zeros(len(marks), dtype=int),
        marks.image,
        network.ids[marks.target],
        transform(T, network.points[marks.target]),
        T[:, :3, :3],
        np.einsum("mij,mj->mi", T[:, :3, :3], normals[marks.target]),
        marks.xy,
        operator.residuals,
        network.redundancy,
        network.redundancy_total,
        operator.whiten,
        operator.project_out,
        None,
        None,
        (frozenset(free),),
        network.radii[marks.target],
        float(1.0 / np.sqrt(np.mean(white**2) * 2.0)),
        network.image_names,
    )


def station_data(orientation: StationOrientation, pose_names: tuple[str, ...]) -> ImageData:
    """The images of an oriented station."""
    marks, design = orientation.marks, orientation.design
    camera_T_world = invert(orientation.world_T_exterior)[marks.exterior]
    T = camera_T_world @ orientation.world_T_body[marks.pose]
    columns = global_columns(marks, len(orientation.world_T_exterior), len(orientation.names))
    A = np.concatenate([design.by_exterior, design.by_interior, design.by_point], axis=2)
    size, poses = len(design.reduced_inverse), len(orientation.poses)

    def remove(flat: Array) -> Array:
        c = flat.reshape(len(marks), 2, -1)
        q = c.shape[2]
        to_global = np.einsum("mip,miq->mpq", A, c)
        b = np.zeros((size, q))
        for j in range(A.shape[2]):
            np.add.at(b, columns[:, j], to_global[:, j])
        v = np.zeros((poses, 6, q))
        np.add.at(v, marks.pose, np.einsum("mip,miq->mpq", design.by_pose, c))
        alone = np.einsum("pij,pjq->piq", design.pose_inverse, v)
        x = design.reduced_inverse @ (b - np.einsum("gpi,piq->gq", design.coupling, alone))
        z = alone - np.einsum("pij,gpj,gq->piq", design.pose_inverse, design.coupling, x, optimize=True)
        left = c - np.einsum("mip,mpq->miq", A, x[columns])
        return (left - np.einsum("mip,mpq->miq", design.by_pose, z[marks.pose])).reshape(flat.shape)

    def whiten(displacement: Array) -> Array:
        return (design.whitening @ displacement).reshape(2 * len(marks), -1)

    unwhite = np.linalg.inv(design.whitening)
    weight = orientation.body.covariance
    held = weight is None or not np.any(weight)
    groups = {
        "focal": ("fx", "fy"),
        "principal": ("cx", "cy"),
        "tangential": ("p1", "p2"),
        "affinity": ("affinity",),
    }
    free = tuple(
        frozenset(part for g in orientation.free_interior.get(name, ()) for part in groups.get(g, (g,)))
        for name in orientation.names
    )
    normals = np.where(np.isfinite(marks.normals), marks.normals, np.nan)
    return ImageData(
        orientation.names,
        orientation.cameras,
        marks.camera,
        marks.pose,
        orientation.body.ids[marks.target],
        transform(T, orientation.body.points[marks.target]),
        T[:, :3, :3],
        np.einsum("mij,mj->mi", T[:, :3, :3], normals),
        marks.xy,
        design.residual.reshape(-1),
        orientation.redundancy,
        int(orientation.redundancy_total),
        whiten,
        remove,
        unwhite @ design.by_exterior,
        unwhite @ design.by_point if held else None,
        free,
        np.nan_to_num(marks.radius),
        float(np.sqrt(np.mean(unwhite**2) * 2.0)),
        tuple(pose_names[int(p)] for p in orientation.poses),
    )

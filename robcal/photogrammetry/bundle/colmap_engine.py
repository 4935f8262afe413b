"""COLMAP as second, independent bundle engine, and export of a network as a COLMAP model for viewing.

COLMAP's pixels have the centre of the top-left one at (0.5, 0.5): converted here and nowhere else. Its adjustment
weighs all marks alike and knows neither scale bars nor eccentricity; its models with k3 free k4 .. k6 as well, so this
engine works with OPENCV (k1, k2, p1, p2) and holds k3 at zero. Covariances are ours, at COLMAP's solution: those of
pycolmap are conditional and assume unit weight.
"""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from robcal.errors import InvalidInput
from robcal.estimation.summary import SolveSummary
from robcal.photogrammetry.bundle.body_frame import Similarity, fit_similarity
from robcal.photogrammetry.bundle.datum import Datum
from robcal.photogrammetry.bundle.determinacy import intrinsics_basis
from robcal.photogrammetry.bundle.lengths import distances, rows_of
from robcal.photogrammetry.bundle.operator import problem_of
from robcal.photogrammetry.bundle.result import NetworkContext, finish
from robcal.photogrammetry.bundle.solver import Bars
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.network import CameraNetwork, ImageMarks, Lengths
from robcal.transforms import Array

_FREE = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


def to_reconstruction(
    camera: Camera,
    camera_T_body: Array,
    points: Array,
    marks: ImageMarks,
    image_names: tuple[str, ...],
    *,
    with_k3: bool = True,
) -> pycolmap.Reconstruction:
    """A COLMAP reconstruction of a network; image and point ids are row numbers plus one."""
    model = pycolmap.Reconstruction()
    c = camera
    parameters = [c.fx, c.fy, c.cx + 0.5, c.cy + 0.5, c.k1, c.k2, c.p1, c.p2]
    full = with_k3 and c.k3 != 0.0
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            camera_id=1,
            model="FULL_OPENCV" if full else "OPENCV",
            width=c.width,
            height=c.height,
            params=[*parameters, c.k3, 0.0, 0.0, 0.0] if full else parameters,
        )
    )
    slot: dict[int, tuple[int, int]] = {}
    for j, name in enumerate(image_names):
        rows = np.flatnonzero(marks.image == j)
        image = pycolmap.Image(name=name, keypoints=marks.xy[rows] + 0.5, camera_id=1, image_id=j + 1)
        T = camera_T_body[j]
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(T[:3, :3]), T[:3, 3]))
        for position, row in enumerate(rows.tolist()):
            slot[row] = (j + 1, position)
    for i, point in enumerate(points):
        track = pycolmap.Track()
        for row in np.flatnonzero(marks.target == i).tolist():
            track.add_element(*slot[row])
        model.add_point3D_with_id(
            i + 1, pycolmap.Point3D(xyz=point, track=track, color=np.array([255, 255, 255], np.uint8))
        )
    return model


def export_colmap(network: CameraNetwork, folder: Path) -> None:
    """Write the network as a COLMAP model (cameras, images, points3D as text) into an existing folder.

    Points keep the row numbers of the network's ids plus one.
    """
    model = to_reconstruction(network.camera, network.camera_T_body, network.points, network.marks, network.image_names)
    with tempfile.TemporaryDirectory(dir=folder) as inside:
        model.write_text(inside)
        for file in Path(inside).iterdir():
            file.replace(folder / file.name)


@contextmanager
def _quiet() -> Iterator[None]:
    """Only errors of COLMAP on standard error."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 2
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def adjust_with_colmap(
    network: CameraNetwork, *, lengths: Lengths | None = None, check_lengths: Lengths | None = None
) -> CameraNetwork:
    """Adjust the marks of a network once more, by COLMAP.

    It starts with neither distortion nor principal point, so that the optimum is independent of ours. The result is
    brought to the scale and frame of ``network`` (by the scale bars if there are any).

    Raises
    ------
    InvalidInput : the adjustment did not come to a usable end, or the interior orientation was to be held.
    """
    lengths = lengths or Lengths.none()
    if not set(_FREE) <= set(network.free_intrinsics):
        held = sorted(set(_FREE) - set(network.free_intrinsics))
        raise InvalidInput(f"engine pycolmap cannot hold {', '.join(held)} alone: use engine robcal for this survey")
    problem, state = problem_of(network, lengths)
    # COLMAP knows points only: it gets the images of the centres, where the ellipses of large dots lie elsewhere
    shift = np.empty((len(network.marks), 2))
    shift[problem.order.order] = problem.shift(state)
    camera, poses, points = _minimised(network, replace(network.marks, xy=network.marks.xy - shift))
    frame = _frame_of(network, points, lengths)
    rows = rows_of(lengths, network.ids)
    free = tuple(name for name in network.free_intrinsics if name != "k3")
    problem = replace(
        problem,
        basis=intrinsics_basis(free),
        bars=Bars(rows, lengths.length, lengths.sigma),
        datum=Datum("inner", np.arange(len(network.ids)), len(lengths) == 0, network.datum),
    )
    state = replace(state, camera=camera, camera_T_body=frame.stations(poses), points=frame.points(points))
    note = "engine pycolmap: marks weighted alike, k3 = 0, scale bars used for the scale only"
    context = NetworkContext(
        free,
        (*network.left_out, ("k3", "not separable in COLMAP's models")),
        network.image_names,
        network.ids,
        network.rejected,
        lengths,
        check_lengths or Lengths.none(),
        (*network.notes, note),
    )
    summary = SolveSummary(True, 0, "by COLMAP", network.summary.cost_start, network.summary.cost)
    return finish(problem, state, summary, context, variance_components=True, iterate=False)


def _minimised(network: CameraNetwork, marks: ImageMarks) -> tuple[Camera, Array, Array]:
    """Camera, stations (n, 4, 4) and points (t, 3) at COLMAP's minimum, in its own scale and frame."""
    c = network.camera
    f = 0.5 * (c.fx + c.fy)
    start = Camera(c.width, c.height, f, f, (c.width - 1) / 2, (c.height - 1) / 2)
    model = to_reconstruction(start, network.camera_T_body, network.points, marks, network.image_names, with_k3=False)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    options.ceres.solver_options.function_tolerance = 1e-12
    options.ceres.solver_options.gradient_tolerance = 1e-10
    options.ceres.solver_options.max_num_iterations = 200
    with _quiet():
        pycolmap.bundle_adjustment(model, options)
    values = np.array(model.cameras[1].params)
    poses = np.tile(np.eye(4), (len(network.image_names), 1, 1))
    for j in range(len(poses)):
        poses[j, :3] = model.images[j + 1].cam_from_world().matrix()
    points = np.array([model.points3D[i + 1].xyz for i in range(len(network.ids))])
    if not np.all(np.isfinite(points)) or not np.all(np.isfinite(values)):
        raise InvalidInput("engine pycolmap did not converge on this network: use engine robcal")
    camera = Camera(c.width, c.height, *values[:2], *(values[2:4] - 0.5), *values[4:8])
    return camera, poses, points


def _frame_of(network: CameraNetwork, points: Array, lengths: Lengths) -> Similarity:
    """Transformation of COLMAP's points (t, 3) onto the network's, its scale from the scale bars if there are any."""
    if len(lengths) == 0:
        return fit_similarity(network.points, points, with_scale=True)
    measured, _ = distances(points, rows_of(lengths, network.ids))
    w = 1.0 / lengths.sigma**2
    scale = float(np.sum(w * measured * lengths.length) / np.sum(w * measured**2))
    return replace(fit_similarity(network.points, scale * points, with_scale=False), scale=scale)

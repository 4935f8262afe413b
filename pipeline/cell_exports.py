"""What a run knows of its cell beside the robot, for ROS and as plain tables: cameras and measured bodies."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from robcal.errors import InvalidInput
from robcal.files.body_file import read_body
from robcal.files.camera_export import ros_text
from robcal.files.camera_file import CameraFile, read_camera
from robcal.files.ros_files import Transform, transform_files
from robcal.files.tables import write_table
from robcal.transforms import Array, xyzrpy_from_frame


def cameras_of(run: Path) -> dict[str, CameraFile]:
    """The calibrated cameras of a run by name; none of a drift control."""
    return {path.stem: read_camera(path) for path in sorted((run / "cameras").glob("*.yaml"))}


def ros_texts(run: Path, world_T_base: Array) -> tuple[dict[str, str], list[str]]:
    """Transforms of base and station cameras in the world, `camera_info` of every camera; what has no such form.

    The robot's description has the links `base_link` and `tool_link`; the world is the measuring system's.
    """
    transforms = [Transform("world_T_base", "world", "base_link", world_T_base)]
    texts: dict[str, str] = {}
    left: list[str] = []
    for name, content in cameras_of(run).items():
        if content.world_T_camera is not None:
            optical = f"{name}_optical_frame"
            transforms.append(Transform(f"world_T_{name}", "world", optical, content.world_T_camera))
        try:
            texts[f"camera_info_{name}.yaml"] = ros_text(content.camera, name)
        except InvalidInput as reason:
            left.append(f"camera {name}: {reason}")
    return {**transform_files(transforms), **texts}, left


def write_cell_tables(run: Path, folder: Path) -> list[Path]:
    """cameras.csv and a table of targets for each body of a run."""
    written = []
    if cameras := cameras_of(run):
        write_table(folder / "cameras.csv", _camera_columns(cameras))
        written.append(folder / "cameras.csv")
    for path in sorted((run / "bodies").glob("*.yaml")):
        targets = read_body(path).targets
        six = [(*(t.xyz or ("", "", "")), *(t.sigma or ("", "", ""))) for t in targets]
        columns: dict[str, Sequence[object]] = {
            "target": ["" if t.id is None else t.id for t in targets],
            "code": [t.code or "" for t in targets],
        }
        for k, name in enumerate(("x_mm", "y_mm", "z_mm", "sx_mm", "sy_mm", "sz_mm")):
            columns[name] = [v[k] if v[k] == "" else f"{1e3 * float(v[k]):.6f}" for v in six]
        write_table(folder / f"body_{path.stem}.csv", columns)
        written.append(folder / f"body_{path.stem}.csv")
    return written


def _camera_columns(cameras: dict[str, CameraFile]) -> dict[str, Sequence[object]]:
    numbers = [c.camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() for c in cameras.values()]
    columns: dict[str, Sequence[object]] = {
        "camera": list(cameras),
        "width": [c.camera.width for c in cameras.values()],
        "height": [c.camera.height for c in cameras.values()],
    }
    columns |= {name: [repr(row[k]) for row in numbers] for k, name in enumerate(("fx", "fy", "cx", "cy"))}
    columns["distortion"] = [" ".join(repr(float(v)) for v in c.camera.distortion) for c in cameras.values()]
    places = [None if c.world_T_camera is None else xyzrpy_from_frame(c.world_T_camera) for c in cameras.values()]
    for k, name in enumerate(("x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg")):
        scale = 1e3 if k < 3 else 180.0 / np.pi
        columns[name] = ["" if six is None else f"{scale * float(six[k]):.9f}" for six in places]
    return columns

"""A hand-eye calibration for other programs: matrices and quaternions, ROS, URDF, OpenCV."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from robcal.errors import InvalidInput
from robcal.files.camera_export import EXPORTS
from robcal.files.storage import write_text
from robcal.photogrammetry.core.camera import Camera
from robcal.transforms import Array, xyzrpy_from_frame

SCALE = np.array([1e3] * 3 + [180.0 / np.pi] * 3)


@dataclass(frozen=True)
class NamedFrame:
    """``<parent>_T_<child>`` with the covariance (6, 6) of its right twist, m and rad."""

    parent: str
    child: str
    T: Array
    covariance: Array

    @property
    def name(self) -> str:
        """As in formulas."""
        return f"{self.parent}_T_{self.child}"


def quaternion(R: Array) -> Array:
    """(x, y, z, w) of a rotation matrix, w not negative (Shepperd 1978)."""
    trace = float(np.trace(R))
    squares = np.array([R[0, 0], R[1, 1], R[2, 2], trace])
    i = int(np.argmax(squares))
    q = np.empty(4)
    if i == 3:
        q[:] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1.0 + trace
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 - trace + 2.0 * R[i, i]
        q[j], q[k], q[3] = R[j, i] + R[i, j], R[k, i] + R[i, k], R[k, j] - R[j, k]
    q /= np.linalg.norm(q)
    return -q if q[3] < 0 else q


def frame_numbers(found: NamedFrame) -> dict[str, Any]:
    """A frame for result.json: mm, deg; sigmas along the axes of the frame that is seen; covariance 6 x 6."""
    six = xyzrpy_from_frame(found.T) * SCALE
    sigma = np.sqrt(np.clip(np.diag(found.covariance), 0.0, None)) * SCALE
    return {
        "xyz_mm": six[:3].tolist(),
        "rpy_deg": six[3:].tolist(),
        "sigma_mm": sigma[:3].tolist(),
        "sigma_deg": sigma[3:].tolist(),
        "covariance": (found.covariance * np.outer(SCALE, SCALE)).tolist(),
        "matrix_m": found.T.tolist(),
        "quaternion_xyzw": quaternion(found.T[:3, :3]).tolist(),
    }


def write_exports(folder: Path, camera_name: str, camera: Camera, frames: list[NamedFrame]) -> list[Path]:
    """Write all exports into a folder; the camera's frame first. Returns their paths."""
    link = _links(camera_name)
    files = {
        "hand_eye.json": json.dumps({f.name: frame_numbers(f) for f in frames}, indent=1) + "\n",
        "static_transform.sh": "".join(f"# {f.name}\n{static_transform(f, camera_name)}\n" for f in frames),
        "static_transform.launch": _launch_1(frames, link),
        "static_transform.launch.py": _launch_2(frames, link),
        "joint.urdf": "".join(_joint(f, link) for f in frames),
        "hand_eye_opencv.yaml": _opencv(camera, frames),
    }
    paths = []
    for name, text in files.items():
        write_text(folder / name, text)
        paths.append(folder / name)
    for name, write in EXPORTS.values():
        try:
            write_text(folder / name, write(camera, camera_name))
        except InvalidInput:
            continue  # that program has no such lens; the command for it says so
        paths.append(folder / name)
    return paths


def _pose(found: NamedFrame) -> tuple[list[str], list[str]]:
    return [f"{v:.9f}" for v in found.T[:3, 3]], [f"{v:.9f}" for v in quaternion(found.T[:3, :3])]


def _links(camera_name: str) -> dict[str, str]:
    """Names of the frames in ROS."""
    return {"flange": "tool0", "base": "base_link", "camera": f"{camera_name}_optical_frame", "board": "board"}


def static_transform(found: NamedFrame, camera_name: str) -> str:
    """The command that publishes a frame in ROS 2."""
    t, q = _pose(found)
    pairs = zip(("x", "y", "z", "qx", "qy", "qz", "qw"), (*t, *q), strict=True)
    numbers = " ".join(f"--{name} {value}" for name, value in pairs)
    link = _links(camera_name)
    ends = f"--frame-id {link[found.parent]} --child-frame-id {link[found.child]}"
    return f"ros2 run tf2_ros static_transform_publisher {numbers} {ends}"


def _launch_1(frames: list[NamedFrame], link: dict[str, str]) -> str:
    rows = []
    for f in frames:
        t, q = _pose(f)
        args = " ".join((*t, *q, link[f.parent], link[f.child]))
        rows.append(f'  <node pkg="tf2_ros" type="static_transform_publisher" name="{f.name}" args="{args}"/>\n')
    return f"<launch>\n{''.join(rows)}</launch>\n"


def _launch_2(frames: list[NamedFrame], link: dict[str, str]) -> str:
    nodes = []
    for f in frames:
        t, q = _pose(f)
        pairs = zip(("x", "y", "z", "qx", "qy", "qz", "qw"), (*t, *q), strict=True)
        words = [word for name, value in pairs for word in (f"--{name}", value)]
        words += ["--frame-id", link[f.parent], "--child-frame-id", link[f.child]]
        nodes.append(
            f'        Node(package="tf2_ros", executable="static_transform_publisher", name="{f.name}",\n'
            f"             arguments={json.dumps(words)}),\n"
        )
    head = "from launch import LaunchDescription\nfrom launch_ros.actions import Node\n\n\n"
    return f"{head}def generate_launch_description():\n    return LaunchDescription([\n{''.join(nodes)}    ])\n"


def _joint(found: NamedFrame, link: dict[str, str]) -> str:
    six = xyzrpy_from_frame(found.T)
    xyz, rpy = (" ".join(f"{v:.9f}" for v in part) for part in (six[:3], six[3:]))
    return (
        f'<joint name="{found.name}" type="fixed">\n  <parent link="{link[found.parent]}"/>\n'
        f'  <child link="{link[found.child]}"/>\n  <origin xyz="{xyz}" rpy="{rpy}"/>\n</joint>\n'
    )


def _opencv(camera: Camera, frames: list[NamedFrame]) -> str:
    storage = cv2.FileStorage("out.yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", camera.matrix)
    storage.write("distortion_coefficients", camera.distortion.reshape(1, -1))
    for f in frames:
        storage.write(f.name, f.T)
        storage.write(f"{f.name}_covariance", f.covariance)
    return str(storage.releaseAndGetString())

"""A hand-eye calibration for other programs: matrices and quaternions, ROS, URDF, OpenCV."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from robcal.errors import InvalidInput
from robcal.files.camera_export import EXPORTS
from robcal.files.ros_files import Transform, quaternion, transform_files
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
    link, transforms = _links(camera_name), [in_ros(f, camera_name) for f in frames]
    files = {
        "hand_eye.json": json.dumps({f.name: frame_numbers(f) for f in frames}, indent=1) + "\n",
        **transform_files(transforms),
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


def _links(camera_name: str) -> dict[str, str]:
    """Names of the frames in ROS."""
    return {"flange": "tool0", "base": "base_link", "camera": f"{camera_name}_optical_frame", "board": "board"}


def in_ros(found: NamedFrame, camera_name: str) -> Transform:
    """A frame under the names that it has in ROS."""
    link = _links(camera_name)
    return Transform(found.name, link[found.parent], link[found.child], found.T)


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

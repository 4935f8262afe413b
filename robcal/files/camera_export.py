"""A calibrated camera for other programs: OpenCV, ROS, Kalibr, COLMAP."""

from collections.abc import Callable, Mapping
from typing import Any

import cv2

from robcal.errors import InvalidInput
from robcal.files.yaml_io import yaml_text
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.lenses import FisheyeCamera, RationalCamera

COLMAP_SHIFT = 0.5
"""COLMAP counts pixels from the corner of the top left one, all others from its centre."""


def opencv_text(camera: Camera, name: str = "camera") -> str:
    """OpenCV's FileStorage as its calibration sample writes it."""
    storage = cv2.FileStorage(f"{name}.yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    if isinstance(camera, FisheyeCamera):
        storage.write("fisheye_model", 1)
    storage.write("camera_matrix", camera.matrix)
    storage.write("distortion_coefficients", camera.distortion.reshape(1, -1))
    return str(storage.releaseAndGetString())


def ros_text(camera: Camera, name: str = "camera") -> str:
    """ROS ``camera_info`` (camera_calibration_parsers): plumb_bob, rational_polynomial or equidistant.

    Raises
    ------
    InvalidInput : thin prism terms, which no model of ROS has.
    """
    model, coefficients = "plumb_bob", camera.distortion.tolist()
    if isinstance(camera, FisheyeCamera):
        model = "equidistant"
    elif isinstance(camera, RationalCamera):
        if any(coefficients[8:]):
            raise InvalidInput("ROS has no lens model with thin prism terms (s1 to s4): calibrate without them")
        model, coefficients = "rational_polynomial", coefficients[:8]
    K = camera.matrix
    P = [*K[0], 0.0, *K[1], 0.0, *K[2], 0.0]
    data = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": _matrix(3, 3, K.ravel().tolist()),
        "distortion_model": model,
        "distortion_coefficients": _matrix(1, len(coefficients), coefficients),
        "rectification_matrix": _matrix(3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        "projection_matrix": _matrix(3, 4, [float(v) for v in P]),
    }
    return yaml_text(data)


def _matrix(rows: int, columns: int, data: list[float]) -> dict[str, Any]:
    return {"rows": rows, "cols": columns, "data": data}


def kalibr_text(camera: Camera, name: str = "camera") -> str:
    """Kalibr's camchain with one camera: pinhole-radtan or pinhole-equi.

    Raises
    ------
    InvalidInput : a lens with k3 or with more terms, which Kalibr's models have not.
    """
    coefficients = camera.distortion.tolist()
    model = "equidistant" if isinstance(camera, FisheyeCamera) else "radtan"
    if model == "radtan" and any(coefficients[4:]):
        raise InvalidInput("Kalibr's pinhole-radtan has k1, k2, p1, p2 only: calibrate without k3 and further terms")
    entry = {
        "camera_model": "pinhole",
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "distortion_model": model,
        "distortion_coeffs": coefficients[:4],
        "resolution": [camera.width, camera.height],
        "rostopic": f"/{name}/image_raw",
    }
    return yaml_text({"cam0": entry})


def colmap_text(camera: Camera, name: str = "camera") -> str:
    """COLMAP's cameras.txt with one camera: OPENCV, FULL_OPENCV or OPENCV_FISHEYE.

    Raises
    ------
    InvalidInput : thin prism terms, which COLMAP's models have not.
    """
    d = camera.distortion.tolist()
    model = "OPENCV"
    if isinstance(camera, FisheyeCamera):
        model = "OPENCV_FISHEYE"
    elif any(d[8:]):
        raise InvalidInput("COLMAP has no lens model with thin prism terms (s1 to s4): calibrate without them")
    elif any(d[4:]):
        model, d = "FULL_OPENCV", [*d[:8], *([0.0] * (8 - len(d)))]
    else:
        d = d[:4]
    numbers = [camera.fx, camera.fy, camera.cx + COLMAP_SHIFT, camera.cy + COLMAP_SHIFT, *d]
    words = " ".join(repr(float(v)) for v in numbers)
    head = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    return f"{head}# {name}\n1 {model} {camera.width} {camera.height} {words}\n"


EXPORTS: Mapping[str, tuple[str, Callable[[Camera, str], str]]] = {
    "opencv": ("opencv.yaml", opencv_text),
    "ros": ("camera_info.yaml", ros_text),
    "kalibr": ("camchain.yaml", kalibr_text),
    "colmap": ("cameras.txt", colmap_text),
}
"""Programs, the usual name of their file, and what writes it."""

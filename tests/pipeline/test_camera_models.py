"""Camera files with other lenses, their way to other programs and back, and their bad cases."""

from pathlib import Path

import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.files.camera_export import EXPORTS, colmap_text, kalibr_text, ros_text
from robcal.files.camera_file import CameraFile, read_camera, write_camera
from robcal.photogrammetry.core.adjustable import adjustable
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.lenses import FisheyeCamera, RationalCamera

BROWN = Camera(1280, 960, 900.0, 905.0, 640.0, 470.0, -0.2, 0.08, 0.001, -0.0007)
RATIONAL = RationalCamera(1280, 960, 900.0, 905.0, 640.0, 470.0, 0.4, 0.2, 0.001, -0.0007, 0.01, 0.6, 0.1, 0.02)
FISHEYE = FisheyeCamera(1280, 960, 400.0, 402.0, 640.0, 470.0, k1=-0.02, k2=0.01, k3=-0.004, k4=0.0008)
CAMERAS = pytest.mark.parametrize("camera", [BROWN, RATIONAL, FISHEYE], ids=["brown", "rational", "fisheye"])


@CAMERAS
def test_own_files_keep_the_lens(tmp_path: Path, camera: Camera) -> None:
    write_camera(tmp_path / "c.yaml", CameraFile(camera))
    assert read_camera(tmp_path / "c.yaml").camera == camera
    write_camera(tmp_path / "c.yaml", CameraFile(adjustable(camera)))
    assert read_camera(tmp_path / "c.yaml").camera == camera


@CAMERAS
@pytest.mark.parametrize("program", ["opencv", "ros", "kalibr"])
def test_files_of_other_programs_are_read_back(tmp_path: Path, camera: Camera, program: str) -> None:
    file, write = EXPORTS[program]
    if program == "kalibr" and camera is RATIONAL:
        with pytest.raises(InvalidInput, match="Kalibr"):
            write(camera, "eye")
        return
    (tmp_path / file).write_text(write(camera, "eye"))
    back = read_camera(tmp_path / file).camera
    assert type(back) is type(camera)
    np.testing.assert_allclose(back.vector, camera.vector, rtol=1e-12)


def test_colmap_counts_from_the_corner_of_a_pixel() -> None:
    line = colmap_text(BROWN).splitlines()[-1].split()
    assert line[:4] == ["1", "OPENCV", "1280", "960"]
    np.testing.assert_allclose([float(v) for v in line[4:]], [900, 905, 640.5, 470.5, -0.2, 0.08, 0.001, -0.0007])
    assert colmap_text(RATIONAL).splitlines()[-1].split()[1] == "FULL_OPENCV"
    assert colmap_text(FISHEYE).splitlines()[-1].split()[1] == "OPENCV_FISHEYE"
    prism = RATIONAL.with_vector([*RATIONAL.vector[:12], 0.001, 0.0, 0.0, 0.0])
    for write in (colmap_text, ros_text, kalibr_text):
        with pytest.raises(InvalidInput):
            write(prism)


HEAD = "format: robcal/camera-1\nwidth: 1280\nheight: 960\nfx: 400\nfy: 400\ncx: 640\ncy: 480\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD + "model: fisheye\np1: 0.1\n", "a fisheye lens has k1 to k4 and no p1"),
        (HEAD + "model: omni\n", "must be 'opencv', 'fisheye' or 'splined'"),
        (HEAD + "k7: 0.1\n", "unknown key 'k7'"),
        (HEAD + "k4: much\n", "must be a number"),
    ],
)
def test_lenses_that_cannot_be_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(InvalidInput, match=message):
        read_camera(tmp_path / "c.yaml")


def test_a_tilted_sensor_is_refused(tmp_path: Path) -> None:
    numbers = ", ".join(["0.0"] * 12 + ["0.01", "0.02"])
    (tmp_path / "c.yaml").write_text(
        "image_width: 1280\nimage_height: 960\ncamera_matrix: {data: [900, 0, 640, 0, 900, 480, 0, 0, 1]}\n"
        f"distortion_coefficients: {{data: [{numbers}]}}\n"
    )
    with pytest.raises(InvalidInput, match="tilted sensor"):
        read_camera(tmp_path / "c.yaml")

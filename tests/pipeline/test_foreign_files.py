"""Camera and robot files of other programs: read with the same numbers, or refused with the remedy."""

import json
import shutil
from dataclasses import astuple
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from pipeline.campaign_reader import read_campaign
from robcal.errors import InvalidInput
from robcal.files.camera_file import read_camera
from robcal.files.robot_import import read_any_robot
from robcal.photogrammetry.core.camera import Camera
from robcal.robot.chain import chain_of, forward
from robcal.robot.export.urdf import urdf_text
from robcal.robot.model import RobotModel
from robcal.transforms import frame_from_xyzrpy
from tests.robot.chains import kr_like

CAMERA = Camera(640, 512, 832.25, 830.5, 334.5, 255.5, -0.072, 0.027, 7.5e-5, 1.3e-4, -0.003)
CASES = Path(__file__).parents[2] / ".." / "shared" / "cases"


def opencv_file(path: Path, more: int = 0) -> Path:
    """As cv::FileStorage writes it, YAML or XML by suffix."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", CAMERA.width)
    storage.write("image_height", CAMERA.height)
    storage.write("camera_matrix", CAMERA.matrix)
    storage.write("distortion_coefficients", np.array([*CAMERA.distortion, *[0.0] * more])[:, None])
    storage.release()
    return path


def ros_file(path: Path, model: str = "plumb_bob", extra: tuple[float, ...] = ()) -> Path:
    matrix = {"rows": 3, "cols": 3, "data": CAMERA.matrix.ravel().tolist()}
    coefficients = {"rows": 1, "cols": 5, "data": [*CAMERA.distortion.tolist(), *extra]}
    data = {"image_width": 640, "image_height": 512, "camera_name": "left", "camera_matrix": matrix}
    data |= {"distortion_model": model, "distortion_coefficients": coefficients}
    path.write_text(yaml.safe_dump(data))
    return path


def ros_message_file(path: Path) -> Path:
    data = {"height": 512, "width": 640, "distortion_model": "plumb_bob"}
    path.write_text(yaml.safe_dump({**data, "d": CAMERA.distortion.tolist(), "k": CAMERA.matrix.ravel().tolist()}))
    return path


def kalibr_file(path: Path, distortion: str = "radtan") -> Path:
    def camera(fx: float) -> dict[str, object]:
        intrinsics = [fx, CAMERA.fy, CAMERA.cx, CAMERA.cy]
        model = {"camera_model": "pinhole", "distortion_model": distortion, "resolution": [640, 512]}
        return {**model, "intrinsics": intrinsics, "distortion_coeffs": CAMERA.distortion[:4].tolist()}

    path.write_text(
        yaml.safe_dump({"cam0": camera(CAMERA.fx), "cam1": {**camera(900.0), "T_cn_cnm1": np.eye(4).tolist()}})
    )
    return path


def metashape_file(path: Path, more: str = "") -> Path:
    c = CAMERA
    numbers = {"f": c.fy, "b1": c.fx - c.fy, "cx": c.cx - 319.5, "cy": c.cy - 255.5, "k1": c.k1, "k2": c.k2, "k3": c.k3}
    numbers |= {"p1": c.p2, "p2": c.p1}
    inner = "".join(f"<{name}>{value!r}</{name}>" for name, value in numbers.items())
    head = '<?xml version="1.0" encoding="UTF-8"?><calibration><projection>frame</projection>'
    path.write_text(f"{head}<width>640</width><height>512</height>{inner}{more}</calibration>")
    return path


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("left.yaml", opencv_file),
        ("left.xml", opencv_file),
        ("ros.yaml", ros_file),
        ("info.yaml", ros_message_file),
        ("camchain.yaml", kalibr_file),
        ("metashape.xml", metashape_file),
        ("metashape.yaml", metashape_file),
    ],
)
def test_camera_files_of_other_programs_are_read(name, write, tmp_path):
    read = read_camera(write(tmp_path / name)).camera
    assert astuple(read)[:-1] == pytest.approx(astuple(CAMERA)[:-1], abs=1e-9)
    assert read.k3 == pytest.approx(0.0 if write is kalibr_file else CAMERA.k3, abs=1e-12)


def test_zero_coefficients_beyond_the_fifth_do_no_harm(tmp_path):
    assert read_camera(opencv_file(tmp_path / "left.yaml", more=9)).camera == CAMERA


def test_a_camera_of_a_chain_is_chosen_by_name(tmp_path):
    path = kalibr_file(tmp_path / "camchain.yaml")
    assert read_camera(f"{path}#cam1").camera.fx == 900.0
    with pytest.raises(InvalidInput, match="cam0, cam1"):
        read_camera(f"{path}#cam7")


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda p: kalibr_file(p, "fov"), "fov.*self-calibrated"),
        (lambda p: ros_file(p, "equidistant"), "a fisheye lens has four coefficients"),
        (lambda p: ros_file(p, "rational_polynomial", (0.1,) * 9), "tilted sensor"),
        (lambda p: metashape_file(p, "<k4>0.01</k4>"), "k4"),
        (lambda p: p.write_text("K: [800, 0, 320, 0, 800, 240, 0, 0, 1]\n"), "size of the images is missing"),
        (lambda p: p.write_text("%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n"), "OpenCV wrote"),
        (lambda p: p.write_text("<!DOCTYPE a [<!ENTITY b 'c'>]><calibration/>"), "entities"),
        (lambda p: p.write_text("<calibration><projection>fisheye</projection></calibration>"), "fisheye"),
        (lambda p: p.write_text("width: 640\nheight: 512\nf: 3\n"), "format"),
    ],
)
def test_what_has_no_counterpart_is_named(write, words, tmp_path):
    write(tmp_path / "left.yaml")
    with pytest.raises(InvalidInput, match=words):
        read_camera(tmp_path / "left.yaml")


@pytest.mark.parametrize(("cx", "cy"), [(14.5, -0.5), (-12.0, 8.0), (0.0, 0.0)])
def test_principal_points_counted_from_the_middle_are_told(cx, cy, tmp_path):
    numbers = f"fx: 832.25\nfy: 832.25\ncx: {cx}\ncy: {cy}\n"
    (tmp_path / "left.yaml").write_text(f"format: robcal/camera-1\nwidth: 640\nheight: 512\n{numbers}")
    with pytest.raises(InvalidInput, match=rf"middle.*\({cx + 319.5:g}, {cy + 255.5:g}\)"):
        read_camera(tmp_path / "left.yaml")


@pytest.mark.skipif(not CASES.is_dir(), reason="the shared cases are not here")
@pytest.mark.parametrize("name", ["kalibr", "opencv", "ros", "metashape_xml", "meta_offset"])
def test_the_shared_camera_files_give_the_campaign_its_camera(name, tmp_path):
    folder = tmp_path / "c"
    shutil.copytree(CASES / "00-base-marks", folder)
    shutil.copy(CASES / "15-camera-files" / f"left_{name}.yaml", folder / "left.yaml")
    if name == "meta_offset":
        with pytest.raises(InvalidInput, match="counted from the middle"):
            read_campaign(folder)
        return
    start = read_campaign(folder).cameras["left"].start
    assert start is not None
    assert (start.camera.fx, start.camera.cx) == pytest.approx((832.25, 334.5), abs=0.6)


def dh_file(path: Path, rows: str, head: str = "a_mm,alpha_deg,d_mm,theta_deg,type,convention") -> Path:
    path.write_text(f"{head}\n{rows}\n")
    return path


def test_denavit_hartenberg_tables_are_robots(tmp_path):
    table = "0,90,127.3,0,revolute,standard\n-612,0,0,0,revolute,standard\n-572.3,0,0,0,revolute,standard\n"
    table += "0,90,163.941,0,revolute,standard\n0,-90,115.7,0,revolute,standard\n0,0,92.2,0,revolute,standard"
    robot = read_any_robot(dh_file(tmp_path / "ur10.csv", table))
    T = forward(chain_of(robot), np.zeros(6))[0]
    assert T[:3, 3] == pytest.approx([-1.1843, -0.256141, 0.0116], abs=1e-12)
    modified = read_any_robot(dh_file(tmp_path / "m.csv", table.replace("standard", "modified")))
    assert forward(chain_of(modified), np.zeros(6))[0][:3, 3] != pytest.approx(T[:3, 3], abs=1e-3)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("0,90,1,0,revolute,craig", "standard or modified"),
        ("0,90,1,0,revolute,standard\n0,0,1,0,revolute,modified", "same in all rows"),
        ("0,90,1,0,ball,standard", "row 2.*ball"),
        ("0,90,612000,0,revolute,standard", "millimetres"),
    ],
)
def test_tables_that_are_no_robot_are_refused(rows, words, tmp_path):
    with pytest.raises(InvalidInput, match=words):
        read_any_robot(dh_file(tmp_path / "dh.csv", rows))


def test_factory_calibration_of_universal_robots(tmp_path):
    rng = np.random.default_rng(8)
    links = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
    numbers = {link: rng.uniform(-1, 1, 6) for link in links}
    data = {k: dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), v.tolist(), strict=True)) for k, v in numbers.items()}
    path = tmp_path / "kinematics.yaml"
    path.write_text(yaml.safe_dump({"kinematics": {**data, "hash": "calib_1"}}))
    q = rng.uniform(-2, 2, 6)
    expected = np.eye(4)
    for link, value in zip(links, q, strict=True):
        expected = expected @ frame_from_xyzrpy(numbers[link]) @ frame_from_xyzrpy([0, 0, 0, 0, 0, value])
    assert forward(chain_of(read_any_robot(path)), q)[0] == pytest.approx(expected, abs=1e-12)
    path.write_text(yaml.safe_dump({"kinematics": {"shoulder": {"x": 1}}}))
    with pytest.raises(InvalidInput, match="shoulder must give"):
        read_any_robot(path)


def _campaign(folder: Path, robot: object, model: RobotModel) -> Path:
    """Perfect frames of a robot, with the given entry ``robot`` in campaign.yaml."""
    q = np.random.default_rng(9).uniform(-60, 60, (12, 6))
    T = forward(chain_of(model), np.radians(q))
    rows = [
        "pose,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg",
        *(f"p{k},{','.join(map(str, v))}" for k, v in enumerate(q)),
    ]
    (folder / "poses.csv").write_text("\n".join(rows) + "\n")
    points = [f"p{k},{','.join(map(str, 1e3 * t[:3, 3]))},0,0,0" for k, t in enumerate(T)]
    (folder / "frames.csv").write_text("\n".join(["pose,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg", *points]) + "\n")
    data = {
        "format": "robcal/campaign-1",
        "name": "c",
        "robot": robot,
        "poses": "poses.csv",
        "measurements": "frames.csv",
    }
    (folder / "campaign.yaml").write_text(json.dumps(data))
    return folder


def test_a_campaign_names_a_urdf_and_the_ends_of_its_chain(tmp_path):
    model = kr_like()
    (tmp_path / "arm.urdf").write_text(urdf_text(model))
    names = [f.name for f in model.joints]
    read = read_campaign(_campaign(tmp_path, "arm.urdf", model)).robot
    assert read is not None
    assert [f.name for f in read.joints] == names
    use = {"file": "arm.urdf", "base_link": f"{names[0]}_link", "tip_link": f"{names[3]}_link"}
    part = read_any_robot(tmp_path / use["file"], use["base_link"], use["tip_link"])
    assert [f.name for f in part.joints] == names[1:4]
    with pytest.raises(InvalidInput, match=r"arm.urdf.*no link 'nowhere' for tip"):
        read_campaign(_campaign(tmp_path, {**use, "tip_link": "nowhere"}, model))
    (tmp_path / "arm.xacro").write_text(
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="r"><xacro:arm/></robot>'
    )
    with pytest.raises(InvalidInput, match=r"arm.xacro.*expand it first"):
        read_campaign(_campaign(tmp_path, "arm.xacro", model))


@pytest.mark.skipif(not CASES.is_dir(), reason="the shared cases are not here")
@pytest.mark.parametrize(
    ("name", "words"),
    [("camera_branch", ""), ("gripper_mimic", ""), ("deg", "degrees"), ("xacro", "xacro"), ("xacro_names", "xacro")],
)
def test_the_shared_descriptions(name, words):
    path = CASES / "16-urdf-and-dh" / f"{name}.urdf"
    if words:
        with pytest.raises(InvalidInput, match=words):
            read_any_robot(path)
    else:
        robot = read_any_robot(path)
        assert robot.n_joints == 3
        assert sum(f.mass for f in robot.frames) == pytest.approx({"camera_branch": 35.0, "gripper_mimic": 30.2}[name])

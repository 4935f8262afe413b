"""Sound files of every kind that the program reads, and who reads them: what `benchmarks.fuzz_inputs` damages."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from pipeline.campaign_schema import FORMAT, CampaignEntry
from pipeline.live.link import numbers
from pipeline.pose_schema import FORMAT as POSES_FORMAT
from pipeline.pose_schema import PosesEntry
from pipeline.prediction import read_wanted
from pipeline.sheets.schema import FORMAT as SHEET_FORMAT
from pipeline.sheets.schema import SheetEntry
from robcal.files.body_file import read_body
from robcal.files.camera_file import read_camera
from robcal.files.cell_files import read_placed
from robcal.files.constraints import read_constraints
from robcal.files.flange_poses import read_flange_poses
from robcal.files.foreign_tables import TableMap, read_mapped_table
from robcal.files.images import read_image
from robcal.files.joint_logs import read_controller_log
from robcal.files.measurement_tables import read_marks, read_measurements
from robcal.files.poses_table import read_poses
from robcal.files.robot_file import read_robot
from robcal.files.robot_import import read_any_robot
from robcal.files.schemas import parse_leniently, read_entry
from robcal.files.tables import read_table
from robcal.files.yaml_io import read_yaml
from robcal.programs.dialects import read_program
from robcal.programs.text import Source

ROBOT = """format: robcal/robot-1
name: two
gravity_m_s2: [0, 0, -9.81]
frames:
  - {name: axis1, axis: z, sign: 1, range_deg: [-185, 185], xyz_mm: [0, 0, 750], rpy_deg: [0, 0, 0], mass_kg: 3}
  - {name: axis2, axis: y, sign: -1, range_deg: [-60, 90], xyz_mm: [350, 0, 0]}
  - {name: flange, axis: null, xyz_mm: [215, 0, 0], rpy_deg: [0, 90, 0]}
parameters: {axis1.x: 0.001}
"""
URDF = """<robot name="r"><link name="base"/><link name="a"><inertial><mass value="2"/>
<origin xyz="0 0 1"/></inertial></link>
<link name="b"/><joint name="j1" type="revolute"><parent link="base"/><child link="a"/><origin xyz="0 0 1" rpy="0 0 0"/>
<axis xyz="0 0 1"/><limit lower="-1" upper="1"/></joint><joint name="j2" type="revolute"><parent link="a"/>
<child link="b"/><origin xyz="1 0 0" rpy="0 1 0"/><axis xyz="0 1 0"/><limit lower="-1" upper="1"/></joint></robot>"""
DH = "a_mm,alpha_deg,d_mm,theta_deg,type,convention\n100,90,300,0,revolute,standard\n400,0,0,90,revolute,standard\n"
UR = "kinematics:\n" + "".join(
    f"  {n}: {{x: 0.1, y: 0, z: 0.2, roll: 0, pitch: 1.5, yaw: 0}}\n"
    for n in ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
)
BODY = """format: robcal/body-1
targets:
  - {id: 17, code: ring12, diameter_mm: 12.0, xyz_mm: [0, 0, 0], sigma_mm: 0.1}
  - {id: 23, code: null, diameter_mm: 12.0, xyz_mm: [400, 0, 0], normal: [0, 0, 1]}
"""
CAMERA = "format: robcal/camera-1\nwidth: 640\nheight: 512\nfx: 800\nfy: 800\ncx: 320\ncy: 256\nk1: -0.1\n"
OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 512
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 800., 0., 320., 0., 800., 256., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0.1, 0., 0., 0., 0. ]
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_model: radtan
  resolution: [640, 512]
  intrinsics: [800, 800, 320, 256]
  distortion_coeffs: [0.1, 0, 0, 0]
"""
METASHAPE = """<?xml version="1.0"?><calibration><projection>frame</projection><width>640</width><height>512</height>
<f>800</f><cx>1</cx><cy>2</cy><k1>0.1</k1></calibration>"""
CAMPAIGN = """format: robcal/campaign-1
name: cell
robot: robot.yaml
poses: {file: poses.csv, columns: {q1_deg: A1}}
payloads: {a: {mass_kg: 3, cog_mm: [0, 0, 1]}}
bodies: {plate: {targets: plate.yaml, survey: {images: s, scale_bars: [{targets: [1, 3], length_mm: 9, sigma_mm: 1}]}}}
station: {cameras: {left: {images: left}}, body: plate}
"""
POSES = "pose,q1_deg,q2_deg,payload,set,time_s,approach1\np1,1,2,,identify,0,1\np2,3,-4,,verify,1,-1\n"
FRAMES = (
    "pose,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg,sigma_mm,sigma_deg\n"
    "p1,1,2,3,4,5,6,0.1,0.1\np2,2,3,4,5,90,7,0.1,0.1\n"
)
POINTS = "pose,target,x_mm,y_mm,z_mm,sigma_mm\np1,17,1,2,3,0.1\np2,23,4,5,6,0.2\n"
MARKS = "image,target,x_px,y_px,sigma_px\na,17,1.5,2.5,0.1\na,23,3,4,0.1\n"
FOREIGN = "head\nNr;X;Y;Z;a;b;c;d\np1;1,5;2;3;1;0;0;0\np2;1;2;3;0;1;0;0\n"
KUKA = "DECL E6AXIS XP1={A1 1.0,A2 -90.5,A3 2,A4 3,A5 4,A6 5,E1 0.0}\nPTP {A1 1,A2 2,A3 3,A4 4,A5 5,A6 6}\n"
ABB = "CONST jointtarget p1:=[[1,2,3,4,5,6],[9E9,9E9]];\nMoveAbsJ [[1,2,3,4,5,7],[9E9,9E9]]\n"
SCRIPT = "global W_q=[0.1, -1.5, 1, 0, 0, 0]\nmovej([0, 0, 0, 0, 0, 1], a=1.2)\n"
RTDE = (
    "timestamp "
    + " ".join(f"actual_q_{k}" for k in range(6))
    + "\n"
    + "1.0 0 0 0 0 0 0\n1.1 0 0 0 0 0 0\n1.9 0 0 0 0 0 0\n"
)
LENGTHS = "pose,distance_mm,sigma_mm\np1,1000.5,0.1\np2,1200,0.1\n"
SENSOR = "pose,cycle,time_s,target,x_mm,y_mm,z_mm,sxx_mm2,sxy_mm2,sxz_mm2,syy_mm2,syz_mm2,szz_mm2\n" + "".join(
    f"{p},1,{t},{k},{t},2,3,0.01,0,0,0.01,0,0.02\n" for t, (p, k) in enumerate((("p1", 1), ("p2", 2)))
)
LOOPS = "pose,constraint,kind,value_mm,sigma_mm\np1,tip,point,,0.1\np2,bar,length,500,0.1\np1,table,plane,3,0.1\n"
WANTED = "pose,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg,temp_room_c\np1,1,2,3,4,5,6,20\np2,2,3,4,5,90,7,21\n"
CELL = """format: robcal/cell-1
flange_T_tool: {xyz_mm: [1, 2, 3], rpy_deg: [0, 90, 10], sigma_mm: [0.1, 0.1, 0.1], sigma_deg: [0, 0, 0.1],
  robot: {parameters: [axis1.x], covariance: [[1], [0], [0], [0], [0], [1]]}}
sigma0: 1.1
residuals_mm: {tip: 0.1}
"""
POSE_REQUEST = """format: robcal/poses-1
robot: robot.yaml
payloads: {plate: {mass_kg: 120, cog_mm: [0, 0, 210]}}
world_T_base: {xyz_mm: [0, 0, 0], rpy_deg: [0, 0, 0]}
body: {targets: plate.yaml, flange_T_body: {xyz_mm: [0, 0, 150], rpy_deg: [0, 0, 0]}, facing: [0, 0, 1]}
cameras: {left: left.yaml}
collision: {link_radius_mm: 200, obstacles: [{kind: floor, height_mm: 0}]}
choice: {method: d_optimal, count: 80, verify: 20}
"""
SHEET = "format: robcal/targets-1\npage: A3\ntargets: {diameter_mm: 12, count: 9, plain: 2}\n" + (
    "layout: {kind: plate, columns: 4, rows: 3, pitch_mm: 60}\n"
)
ROS = """image_width: 640
image_height: 512
camera_name: cam
camera_matrix: {rows: 3, cols: 3, data: [800, 0, 320, 0, 800, 256, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}
"""
KRL = """DEF weld()
$TOOL = {X 10, Y 0, Z 150, A 0, B 0, C 0}
$BASE = {X 900, Y 0, Z 100, A 5, B 0, C 0}
PTP {E6AXIS: A1 1, A2 -90, A3 90, A4 0, A5 5, A6 0}
FOR I=1 TO 3
LIN {POS: X 100, Y 20.5, Z 30, A 0, B 90, C 0, S 2, T 10} C_DIS
ENDFOR
CIRC {X 1, Y 2, Z 3, A 4, B 5, C 6}, {X 2, Y 2, Z 3, A 4, B 5, C 6}
END
"""
RAPID = """MODULE Test
  TASK PERS tooldata tGrip:=[TRUE,[[10,0,150],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];
  CONST robtarget p10:=[[900,0,700],[0,0,1,0],[0,0,0,0],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]];
  PROC main()
    MoveAbsJ [[0,0,0,0,30,0],[9E9,9E9,9E9,9E9,9E9,9E9]]\\NoEOffs,v1000,fine,tGrip;
    MoveL Offs(p10, -20, 2*15, 100), v100, fine, tGrip;
  ENDPROC
ENDMODULE
"""
UR_PROGRAM = """def part():
  set_tcp(p[0, 0.01, 0.15, 0, 0, 0])
  home = p[0.5, 0.1, 0.4, 3.14, 0, 0]
  movej([0, -1.5, 1.5, 0, 0.3, 0], a=1.4, v=1.05)
  movel(pose_trans(home, p[0, 0, -0.05, 0, 0, 0]), a=1.2)
end
"""
FANUC = """/PROG  TEST
/MN
   1:  UFRAME_NUM=0 ;
   2:J P[1] 100% FINE    ;
   3:L P[2:corner] 500mm/sec CNT50    ;
/POS
P[1]{
   GP1:
\tUF : 0, UT : 0,
\tJ1= 0.000 deg,\tJ2= 10.000 deg,\tJ3= 0.000 deg,\tJ4= 0.000 deg,\tJ5= 30.000 deg,\tJ6= 0.000 deg
};
P[2:"corner"]{
   GP1:
\tUF : 0, UT : 0,\t\tCONFIG : 'N U T, 0, 0, 0',
\tX = 900.000 mm,\tY = 0.000 mm,\tZ = 700.000 mm,\tW = 180.000 deg,\tP = 0.000 deg,\tR = 0.000 deg
};
/END
"""


def _image(suffix: str) -> bytes:
    picture = np.full((24, 32), 20, np.uint8)
    cv2.circle(picture, (16, 12), 6, 200, -1)
    return bytes(cv2.imencode(suffix, picture)[1].tobytes())


def _campaign(path: Path) -> object:
    return parse_leniently(read_yaml(path), CampaignEntry, FORMAT)


def _program(dialect: str) -> Callable[[Path], object]:
    return lambda path: read_program(dialect, Source(str(path), path.read_bytes().decode("latin-1")))


def _message(path: Path) -> list[float]:
    """The numbers of a line of the live link."""
    return numbers(path.read_bytes().decode("utf-8", "replace").split()[1:], 6, str(path))


_MAP = TableMap({"pose": "Nr", "x_m": "X", "qw": "a", "qx": "b", "qy": "c", "qz": "d"}, ";", ",", 1, True, "quaternion")
READERS: dict[str, tuple[str, bytes, Callable[[Path], object]]] = {
    "campaign": (".yaml", CAMPAIGN.encode(), _campaign),
    "robot": (".yaml", ROBOT.encode(), read_robot),
    "urdf": (".urdf", URDF.encode(), read_any_robot),
    "dh": (".csv", DH.encode(), read_any_robot),
    "ur kinematics": (".yaml", UR.encode(), read_any_robot),
    "body": (".yaml", BODY.encode(), read_body),
    "camera": (".yaml", CAMERA.encode(), read_camera),
    "camera of opencv": (".yaml", OPENCV.encode(), read_camera),
    "camera of kalibr": (".yaml", KALIBR.encode(), read_camera),
    "camera of metashape": (".xml", METASHAPE.encode(), read_camera),
    "poses": (".csv", POSES.encode(), lambda p: read_poses(p, None, ())),
    "frames": (".csv", FRAMES.encode(), lambda p: read_measurements(p, ("p1", "p2"))),
    "points": (".csv", POINTS.encode(), lambda p: read_measurements(p, ("p1", "p2"))),
    "marks": (".csv", MARKS.encode(), read_marks),
    "foreign table": (".txt", FOREIGN.encode(), lambda p: read_mapped_table(p, _MAP)),
    "log of kuka": (".dat", KUKA.encode(), read_controller_log),
    "log of abb": (".mod", ABB.encode(), read_controller_log),
    "log of ur": (".script", SCRIPT.encode(), read_controller_log),
    "recording of ur": (".csv", RTDE.encode(), read_controller_log),
    "camera of ros": (".yaml", ROS.encode(), read_camera),
    "lengths": (".csv", LENGTHS.encode(), lambda p: read_measurements(p, ("p1", "p2"))),
    "sensor points": (".csv", SENSOR.encode(), lambda p: read_measurements(p, ("p1", "p2"))),
    "closed loops": (".csv", LOOPS.encode(), lambda p: read_constraints(read_table(p))),
    "frames of the flange": (".csv", FRAMES.encode(), read_flange_poses),
    "frames wanted": (".csv", WANTED.encode(), lambda p: read_wanted(p, ())),
    "result of the cell": (".yaml", CELL.encode(), lambda p: read_placed(p, "flange_T_tool")),
    "poses wanted": (".yaml", POSE_REQUEST.encode(), lambda p: read_entry(p, PosesEntry, POSES_FORMAT)),
    "sheet of targets": (".yaml", SHEET.encode(), lambda p: read_entry(p, SheetEntry, SHEET_FORMAT)),
    "program in KRL": (".src", KRL.encode(), _program("krl")),
    "program in RAPID": (".mod", RAPID.encode(), _program("rapid")),
    "program in URScript": (".script", UR_PROGRAM.encode(), _program("urscript")),
    "program of Fanuc": (".ls", FANUC.encode(), _program("fanuc")),
    "message of the live link": (".txt", b"JOINTS 1.0 -2.5 3 4 5 6e1", _message),
    **{f"image{suffix}": (suffix, _image(suffix), read_image) for suffix in (".png", ".tif", ".jpg", ".bmp")},
}

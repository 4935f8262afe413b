"""Damaged files into every reader: each must be read or refused with a sentence; anything else is a crash.

    python -m benchmarks.fuzz_inputs --cases 100000

Every case is a sound file of its kind with one to four mutations (bytes, lines, cells and numbers exchanged, repeated,
cut, or replaced by hostile ones), from a seed, so that a crash can be repeated by its number.
"""

import argparse
import random
import resource
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from robcal.errors import RobcalError
from robcal.files.body_file import read_body
from robcal.files.camera_file import read_camera
from robcal.files.foreign_tables import TableMap, read_mapped_table
from robcal.files.images import read_image
from robcal.files.joint_logs import read_controller_log
from robcal.files.measurement_tables import read_marks, read_measurements
from robcal.files.poses_table import read_poses
from robcal.files.robot_file import read_robot
from robcal.files.robot_import import read_any_robot
from robcal.files.schemas import parse_leniently
from robcal.files.yaml_io import read_yaml

HOSTILE = (
    *(
        "nan",
        "-inf",
        "1e999",
        "1e308",
        "9" * 400,
        "-0",
        "",
        "null",
        "true",
        "'",
        '"',
        "\x00",
        "\ufeff",
        "\u202e",
        "é",
        "💥",
    ),
    *(
        "../../etc/passwd",
        "<script>",
        "[",
        "{",
        "&a [*a, *a]",
        "*a",
        "!!python/object:os.system",
        "<<: *a",
        "---",
        "#",
        ";",
    ),
    *(
        ",,,,",
        "\t",
        "\r",
        "A" * 5000,
        "%s%n",
        "1,5",
        "0x10",
        "1_000",
        "CON",
        "<!DOCTYPE a [<!ENTITY b 'c'>]>",
        "<",
        ">",
        "/>",
    ),
)
SLOW = 5.0
"""Seconds above which a single case counts as hanging."""

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


def _image(suffix: str) -> bytes:
    picture = np.full((24, 32), 20, np.uint8)
    cv2.circle(picture, (16, 12), 6, 200, -1)
    return bytes(cv2.imencode(suffix, picture)[1].tobytes())


def _campaign(path: Path) -> object:
    from pipeline.campaign_schema import FORMAT, CampaignEntry

    return parse_leniently(read_yaml(path), CampaignEntry, FORMAT)


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
    **{f"image{suffix}": (suffix, _image(suffix), read_image) for suffix in (".png", ".tif", ".jpg", ".bmp")},
}


def mutated(raw: bytes, rng: random.Random) -> bytes:
    """A file with one to four things wrong."""
    for _ in range(rng.randint(1, 4)):
        kind, n = rng.randrange(7), max(len(raw), 1)
        i, j = sorted((rng.randrange(n), rng.randrange(n)))
        word = rng.choice(HOSTILE).encode("utf-8", "surrogatepass")
        if kind == 0:
            raw = raw[:i] + bytes([rng.randrange(256)]) + raw[i + 1 :]
        elif kind == 1:
            raw = raw[:i] + word + raw[i:]
        elif kind == 2:
            raw = raw[:i] + raw[min(j, i + 40) :]
        elif kind == 3:
            raw = raw[:j] + raw[i:j] * rng.choice((1, 1, 2, 30)) + raw[j:]
        elif kind == 4:
            raw = raw[:i]
        elif kind == 5:
            lines = raw.split(b"\n")
            rng.shuffle(lines)
            raw = b"\n".join(lines)
        else:  # a whole token gives way to a hostile one
            cells = raw.replace(b",", b"\n,\n").replace(b" ", b"\n \n").split(b"\n")
            at = rng.randrange(len(cells))
            raw = raw.replace(cells[at], word, 1) if cells[at] else raw
        raw = raw[:200_000]
    return raw


def one_case(number: int, folder: Path) -> tuple[str, str]:
    """Kind of the file, and 'read', 'refused', or what went wrong."""
    rng = random.Random(number)
    kind = list(READERS)[number % len(READERS)]
    suffix, sound, read = READERS[kind]
    path = folder / f"case{suffix}"
    path.write_bytes(mutated(sound, rng))
    begin = time.perf_counter()
    try:
        read(path)
        outcome = "read"
    except RobcalError as error:
        outcome = "refused" if str(error).strip() else "refused without a word"
    except Exception as error:
        outcome = f"crashed: {type(error).__name__}: {error}"[:160]
    slow = time.perf_counter() - begin > SLOW
    return kind, f"took more than {SLOW:g} s" if slow else outcome


def run_cases(first: int, cases: int) -> tuple[Counter[tuple[str, str]], dict[str, int]]:
    """Outcomes counted by kind; by outcome that is none of the wanted ones the number of its first case."""
    counts: Counter[tuple[str, str]] = Counter()
    examples: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(first, first + cases):
            kind, outcome = one_case(number, Path(folder))
            counts[kind, outcome if outcome in ("read", "refused") else "crashed"] += 1
            if outcome not in ("read", "refused"):
                examples.setdefault(f"{kind}: {outcome}", number)
    return counts, examples


def main() -> None:
    """Print a table of outcomes."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first case: it is its seed")
    chosen = parser.parse_args()
    begin = time.perf_counter()
    counts, examples = run_cases(chosen.first, chosen.cases)
    print("| file | read | refused in a sentence | crashed or hung |\n|---|---|---|---|")
    for kind in READERS:
        print(f"| {kind} | " + " | ".join(str(counts[kind, o]) for o in ("read", "refused", "crashed")) + " |")
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"\n{sum(counts.values())} cases in {time.perf_counter() - begin:.0f} s, at most {memory:.0f} MB")
    for what, number in examples.items():
        print(f"case {number}: {what}")
    raise SystemExit(1 if examples else 0)


if __name__ == "__main__":
    main()

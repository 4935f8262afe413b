"""A hand-eye calibration from a campaign folder: results, files for other programs, what is told, bad inputs."""

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import yaml

from fixtures.board_pattern import BoardPattern
from fixtures.campaigns import write_table, write_yaml
from fixtures.hand_eye import Scene, exchanged, looking, place, scene, turn
from fixtures.hand_eye_files import write_images, write_scene
from fixtures.optics import TrueCamera
from fixtures.true_robot import Circumstances, TrueRobot
from pipeline.pose_generation import generate_poses
from pipeline.prediction import predict_run
from pipeline.runner import run_campaign
from robcal.errors import InvalidInput
from robcal.files.camera_file import read_camera
from robcal.files.robot_import import read_any_robot
from robcal.robot.inverse import inverse_kinematics, select
from robcal.transforms import difference, frame_from_xyzrpy

ROBOT = Path(__file__).parents[2] / "configs" / "robots" / "irb120_like.yaml"


def made(seed: int = 1, mounted: str = "hand", n: int = 12, **more: object) -> Scene:
    return scene(np.random.default_rng(seed), mounted, n, 0.1, (1e-4, 1e-4), **more)  # type: ignore[arg-type]


def error_in_sigmas(told: dict, true: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    T = frame_from_xyzrpy([*np.array(told["xyz_mm"]) / 1e3, *np.radians(told["rpy_deg"])])
    sigma = np.concatenate([np.array(told["sigma_mm"]) / 1e3, np.radians(told["sigma_deg"])])
    return np.asarray(difference(true, T) / sigma)


@pytest.fixture(scope="module")
def hand_run(tmp_path_factory):  # type: ignore[no-untyped-def]
    X = place(turn(np.array([0.1, -0.1, 0.4])), np.array([0.03, 0.02, 0.05]))
    Z = place(turn(np.array([np.pi, 0.0, 0.0])), np.array([0.3, 0.1, 0.0]))
    seen = made(2, carriers=(X, Z))
    root = tmp_path_factory.mktemp("hand")
    done = run_campaign(write_scene(root / "campaign", seen), root / "run")
    return root / "run", seen, done.result


def test_result_has_camera_and_board_with_their_uncertainty(hand_run) -> None:  # type: ignore[no-untyped-def]
    _, seen, result = hand_run
    found = result["hand_eye"]
    assert np.all(np.abs(error_in_sigmas(found["flange_T_camera"], seen.X)) < 5)
    assert np.all(np.abs(error_in_sigmas(found["base_T_board"], seen.Z)) < 5)
    C = np.array(found["flange_T_camera"]["covariance"])
    np.testing.assert_allclose(np.sqrt(np.diag(C))[:3], found["flange_T_camera"]["sigma_mm"])
    assert found["images"] == 12
    assert 0.1 < found["heldout_px"] < 2
    assert 0.03 < found["heldout_mm"] < 1
    assert 0.9 < found["sigma0"] < 1.1
    assert found["rejected"] == []


def test_exports_say_the_same(hand_run) -> None:  # type: ignore[no-untyped-def]
    run, _, result = hand_run
    told = result["hand_eye"]["flange_T_camera"]
    T = np.array(told["matrix_m"])
    kept = read_camera(run / "cameras" / "eye.yaml")
    assert kept.flange_T_camera is not None
    np.testing.assert_allclose(kept.flange_T_camera, T, atol=1e-8)
    joint = ElementTree.fromstring(f"<all>{(run / 'hand_eye' / 'joint.urdf').read_text()}</all>")[0]
    origin = joint.find("origin")
    assert origin is not None
    six = [float(v) for key in ("xyz", "rpy") for v in str(origin.get(key)).split()]
    np.testing.assert_allclose(frame_from_xyzrpy(six), T, atol=1e-7)
    storage = cv2.FileStorage(str(run / "hand_eye" / "hand_eye_opencv.yaml"), cv2.FILE_STORAGE_READ)
    np.testing.assert_allclose(storage.getNode("flange_T_camera").mat(), T, atol=1e-12)
    x, y, z, w = told["quaternion_xyzw"]
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    np.testing.assert_allclose(R, T[:3, :3], atol=1e-9)
    command = (run / "hand_eye" / "static_transform.sh").read_text()
    assert "--frame-id tool0 --child-frame-id eye_optical_frame" in command
    compile((run / "hand_eye" / "static_transform.launch.py").read_text(), "launch", "exec")
    ElementTree.fromstring((run / "hand_eye" / "static_transform.launch").read_text())


def test_the_report_has_a_chapter(hand_run) -> None:  # type: ignore[no-untyped-def]
    text = (hand_run[0] / "report.html").read_text()
    assert "Hand-eye" in text
    assert "ros2 run tf2_ros" in text


def test_a_camera_beside_the_robot_and_a_pushed_board(tmp_path: Path) -> None:
    push = place(turn(np.array([0.0, 0.0, 0.05])), np.array([0.02, 0.01, 0.0]))
    seen = made(3, "world", bump=(6, push))
    done = run_campaign(write_scene(tmp_path / "campaign", seen, calibration=False), tmp_path / "run")
    found = done.result["hand_eye"]
    assert np.all(np.abs(error_in_sigmas(found["base_T_camera"], seen.X)) < 5)
    diagnosis = json.loads((tmp_path / "run" / "diagnosis.json").read_text())
    cause = diagnosis["causes"][0]
    assert (cause["cause"], cause["where"], cause["parameters"]["pose"]) == ("board_moved", "board", "p006")
    np.testing.assert_allclose(cause["parameters"]["shift_mm"], [20, 10, 0], atol=1.0)
    np.testing.assert_allclose(cause["parameters"]["turn_deg"], [0, 0, np.degrees(0.05)], atol=0.2)
    assert diagnosis["mismatch"] is True


def test_joint_angles_of_a_robot_and_its_predictions(tmp_path: Path) -> None:
    """The camera of a run with a robot is predicted at other poses, in board coordinates."""
    carriers = (
        place(turn(np.array([0.1, -0.1, 0.4])), np.array([0.03, 0.02, 0.05])),
        place(turn(np.array([0.1, 0.05, 0.2])), np.array([0.25, -0.1, 0.0])),
    )
    below = place(turn(np.array([np.pi, 0, 0])), np.zeros(3))
    rng = np.random.default_rng(4)
    seen = scene(rng, "hand", 60, 0.1, distance=(0.3, 0.45), cone=0.5, carriers=(carriers[0], carriers[1] @ below))
    robot = read_any_robot(ROBOT)
    solved = inverse_kinematics(robot, seen.actual)
    picked = select(solved, explain=False)
    good = np.flatnonzero(np.isfinite(picked.q).all(axis=1))[:16]
    assert len(good) >= 12
    where = {int(i): k for k, i in enumerate(good)}
    kept = np.isin(seen.image, good)
    image = np.array([where[int(i)] for i in seen.image[kept]])
    seen = replace(seen, commanded=seen.commanded[good], image=image, target=seen.target[kept], xy=seen.xy[kept])
    folder = write_scene(tmp_path / "campaign", seen, flange=None)
    q = np.degrees(picked.q[good])
    names = [f"p{i:03d}" for i in range(len(good))]
    write_table(
        folder / "poses.csv",
        {"pose": names}
        | {f"q{k + 1}_deg": q[:, k].tolist() for k in range(6)}
        | {"set": ["verify" if i % 4 == 3 else "identify" for i in range(len(good))]},
    )
    content = yaml.safe_load((folder / "campaign.yaml").read_text())
    content |= {"robot": str(ROBOT), "poses": "poses.csv", "model": {"parameters": "none"}}
    write_yaml(folder / "campaign.yaml", content)
    done = run_campaign(folder, tmp_path / "run")
    found = done.result["hand_eye"]
    assert found["heldout_kind"] == "verify"
    assert found["heldout_images"] == len(good) // 4
    assert found["heldout_px"] < 0.3
    assert np.all(np.abs(error_in_sigmas(found["flange_T_camera"], seen.X)) < 5)
    predict_run(tmp_path / "run", folder / "poses.csv", tmp_path / "frames.csv")
    rows = np.loadtxt(tmp_path / "frames.csv", delimiter=",", skiprows=1, usecols=range(1, 7))
    predicted = frame_from_xyzrpy(np.column_stack([rows[:, :3] / 1e3, np.radians(rows[:, 3:])]))
    true = TrueRobot(yaml.safe_load(ROBOT.read_text()), world_T_base=np.linalg.inv(seen.Z), flange_T_tool=seen.X)
    T = true.world_T_tool(np.radians(q), Circumstances.plain(len(q), 6))
    assert np.abs(predicted[:, :3, 3] - T[:, :3, 3]).max() < 5e-4


def test_exchanged_images_are_named(tmp_path: Path) -> None:
    seen = exchanged(made(5), 2, 7)
    found = run_campaign(write_scene(tmp_path / "c", seen), tmp_path / "r", until="hand_eye").result["hand_eye"]
    assert {r["image"] for r in found["rejected"]} == {"p002", "p007"}
    assert "fits the joint angles of pose p007" in found["rejected"][0]["reason"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"board": "bord"}, "no body 'bord' under 'bodies': did you mean 'board'"),
        ({"flange": None}, "needs to know where the flange was"),
        ({"mounted": "arm"}, "must be 'hand' or 'world'"),
        ({"camera": {"observations": "marks.csv", "hold": True}}, "'hold: true' needs the 'calibration'"),
        ({"camera": {"name": "eye"}}, "needs either 'images'"),
        ({"camera": {"name": "eye", "observations": "marks.csv", "held": True}}, "unknown key 'held'"),
        ({"flange": "marks.csv"}, "marks.csv"),
        ({"board_scale_ppm": -1}, "larger than zero"),
    ],
)
def test_bad_entries_get_a_sentence(tmp_path: Path, change: dict, message: str) -> None:  # type: ignore[type-arg]
    folder = write_scene(tmp_path / "c", made(6, n=4), **change)
    with pytest.raises(InvalidInput, match=message) as caught:
        run_campaign(folder, tmp_path / "r")
    assert "\n" not in str(caught.value)
    assert "campaign.yaml" in str(caught.value) or "marks.csv" in str(caught.value)


def test_motions_about_one_axis_are_refused_with_the_file_named(tmp_path: Path) -> None:
    seen = made(7)
    rng = np.random.default_rng(1)
    angles = np.linspace(-0.5, 0.5, 12)
    spun = [seen.commanded[0] @ place(turn(np.array([0, a, 0])), 0.05 * rng.normal(size=3)) for a in angles]
    folder = write_scene(tmp_path / "c", replace(seen, commanded=np.array(spun)))
    with pytest.raises(Exception, match=r"campaign.yaml: hand_eye.*one direction only.*about its [xz] or [xz] axis"):
        run_campaign(folder, tmp_path / "r")


def test_the_next_poses_are_proposed_from_guesses_and_from_a_run(hand_run, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    run = hand_run[0]
    campaign = run.parent / "campaign"
    guess = {
        "camera": str(campaign / "eye.yaml"),
        "board": str(campaign / "board.yaml"),
        "flange_T_camera": {"xyz_mm": [30, 20, 50], "rpy_deg": [0, 0, 20]},
        "base_T_board": {"xyz_mm": [300, 100, 0], "rpy_deg": [180, 0, 0]},
    }
    base = {"format": "robcal/poses-1", "robot": str(ROBOT), "choice": {"count": 5, "verify": 1, "candidates": 120}}
    write_yaml(tmp_path / "poses.yaml", base | {"hand_eye": guess})
    told = generate_poses(tmp_path / "poses.yaml", tmp_path / "poses.csv")
    assert told["poses"] == 6
    assert len((tmp_path / "poses.csv").read_text().splitlines()) == 7
    for change, words in (
        ({"base_T_board": None}, "base_T_board is missing"),
        ({"camera": None}, "needs a 'run'"),
        ({"distance_mm": [500, 300]}, "exchange the two"),
        ({"run": str(tmp_path)}, "not a run folder"),
    ):
        write_yaml(tmp_path / "bad.yaml", base | {"hand_eye": {k: v for k, v in (guess | change).items() if v}})
        with pytest.raises(InvalidInput, match=words):
            generate_poses(tmp_path / "bad.yaml", tmp_path / "bad.csv")
    write_yaml(tmp_path / "again.yaml", base | {"hand_eye": {"run": str(run)}})
    told = generate_poses(tmp_path / "again.yaml", tmp_path / "again.csv")
    assert np.linalg.norm(told["sigma_mm"]) < 0.2


@pytest.mark.slow
def test_from_rendered_images_of_a_charuco_board(tmp_path: Path) -> None:
    pattern = BoardPattern("charuco", 7, 5, square=0.03, marker=0.022)
    camera = TrueCamera(560, 420, 640.0, 640.0, 281.0, 208.0, k1=-0.1, psf_px=0.7)
    rng = np.random.default_rng(3)
    marks = np.column_stack([pattern.marks(), np.zeros(len(pattern.marks()))])
    views = np.array([looking(rng, marks, (0.3, 0.42), 0.6, np.pi) for _ in range(6)])
    seen = scene(rng, "hand", views=views, scatter=(1e-4, 1e-4))
    folder = write_images(tmp_path / "c", pattern, camera, seen, views)
    found = run_campaign(folder, tmp_path / "r").result["hand_eye"]
    assert found["images"] == 6
    assert np.all(np.abs(error_in_sigmas(found["flange_T_camera"], seen.X)) < 5)
    assert found["heldout_px"] < 1.0
    assert found["noise_px"] < 0.1

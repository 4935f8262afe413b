"""A calibrated robot as Universal Robots' own calibration says the same as its model."""

import numpy as np
import pytest
import yaml

from fixtures.rigid import frame_from_six, turn_about
from robcal.errors import InvalidInput
from robcal.files.robot_import import read_any_robot, read_ur_joints
from robcal.robot.export.ur_kinematics import KINDS, ur_kinematics
from robcal.robot.kernel import Kernel
from tests.robot.chains import kr_like

UR10 = {
    "shoulder": [0, 0, 0.1273, 0, 0, 0],
    "upper_arm": [0, 0, 0, 1.570796327, 0, 0],
    "forearm": [-0.612, 0, 0, 0, 0, 0],
    "wrist_1": [-0.5723, 0, 0.163941, 0, 0, 0],
    "wrist_2": [0, -0.1157, 0, 1.570796327, 0, 0],
    "wrist_3": [0, 0.0922, 0, 1.570796326589793, 3.141592653589793, 3.141592653589793],
}


def test_it_says_what_the_model_says(tmp_path):
    path = tmp_path / "kinematics.yaml"
    entries = {link: dict(zip(KINDS, map(float, six), strict=True)) for link, six in UR10.items()}
    path.write_text(yaml.safe_dump({"kinematics": {**entries, "hash": "calib_1"}}))
    nominal = read_any_robot(path)
    rng = np.random.default_rng(0)
    names = [f"{f.name}.{kind}" for f in nominal.frames for kind in KINDS]
    model = nominal.with_parameters(dict(zip(names, rng.normal(0, 1e-3, len(names)), strict=True)))
    found, left = ur_kinematics(model, read_ur_joints(path))
    assert np.max(np.abs(left - np.eye(4))) < 2e-2
    kernel = Kernel(model)
    for q in rng.uniform(-2, 2, (5, 6)):
        T = np.eye(4)
        for entry, angle in zip(found.values(), q, strict=True):
            turned = np.eye(4)
            turned[:3, :3] = turn_about(2, angle)
            T = T @ frame_from_six([entry[k] for k in KINDS]) @ turned
        expected = kernel.frames(kernel.theta0, kernel.poses(q))[0]
        assert T @ left == pytest.approx(expected, abs=1e-9)


def test_another_robot_is_refused(tmp_path):
    path = tmp_path / "kinematics.yaml"
    entries = {link: dict(zip(KINDS, map(float, six), strict=True)) for link, six in UR10.items()}
    path.write_text(yaml.safe_dump({"kinematics": entries}))
    with pytest.raises(InvalidInput, match=r"not read from a kinematics\.yaml"):
        ur_kinematics(kr_like(), read_ur_joints(path))

"""Deviations of base and tool become part of the references without moving the tool."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.calibrated import with_folded_cell
from pipeline.robot_file import read_robot
from robcal.robot.kernel import Kernel
from robcal.transforms import frame_from_xyzrpy

UR10 = Path(__file__).parents[2] / "configs" / "robots" / "ur10.yaml"


def test_folding_the_cell_moves_nothing() -> None:
    rng = np.random.default_rng(2)
    deviations = {f"{end}.{k}": float(v) for end in ("base", "tool") for k, v in zip(
        ("x", "y", "z", "roll", "pitch", "yaw"), rng.normal(0, 1e-2, 6), strict=True)}  # fmt: skip
    ends = frame_from_xyzrpy(rng.normal(size=(2, 6)))
    model = replace(
        read_robot(UR10), parameters={"axis2.x": 1e-3, **deviations}, world_T_base=ends[0], flange_T_tool=ends[1]
    )
    folded = with_folded_cell(model)
    assert set(folded.parameters) == {"axis2.x"}
    before, after = Kernel(model), Kernel(folded)
    q = rng.uniform(-1, 1, (9, 6))
    expected = before.frames(before.theta0, before.poses(q))
    np.testing.assert_allclose(after.frames(after.theta0, after.poses(q)), expected, atol=1e-12)

"""Campaigns with several instruments: from their files to result.json and predict --instrument; truth from fixtures."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fixtures.effects import Effect
from fixtures.instruments import Watcher, placement, watch, write_watched
from fixtures.plan import Plan
from pipeline.campaign_reader import read_campaign
from pipeline.prediction import predict_run
from pipeline.runner import run_campaign
from pipeline.stages.identify import options_of
from robcal.errors import InvalidInput
from robcal.files.tables import read_table

PLAN = Plan(seed=3, poses=120, verify=15, model="table5.4", kept_out=2)
TURNS = [f"{end}.{kind}" for end in ("world_T_base", "flange_T_tool") for kind in ("roll", "pitch", "yaw")]


@pytest.fixture(scope="module")
def wires_and_tracker(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    """Two wires identify, a tracker verifies."""
    folder = tmp_path_factory.mktemp("wires")
    wire = Watcher("distances", poses="identify", sigma_mm=0.02)
    made = watch(PLAN, {"tracker": Watcher(poses="verify"), "left": wire, "right": wire})
    write_watched(folder / "campaign", made)
    run_campaign(folder / "campaign", out=folder / "run", until="verify")
    return made, folder


def test_lengths_identify_and_frames_verify(wires_and_tracker: tuple[Any, Path]) -> None:
    _, folder = wires_and_tracker
    result = json.loads((folder / "run" / "result.json").read_text())
    wire, tracker = result["instruments"]["left"], result["instruments"]["tracker"]
    assert (wire["kind"], wire["poses"], wire["held"]) == ("distances", 120, TURNS)
    assert 0.8 < wire["sigma0"] < 1.2
    assert (tracker["kind"], tracker["poses"], tracker["sigma0"]) == ("frames", 0, None)
    assert result["verification"]["tools"] == tracker["verification"]["tools"]
    assert tracker["verification"]["tools"]["0"]["mean"] < 0.15
    assert tracker["verification"]["nominal"]["0"]["mean"] > 2.0


def test_predictions_are_made_in_the_world_of_the_named_instrument(wires_and_tracker: tuple[Any, Path]) -> None:
    made, folder = wires_and_tracker
    poses, out = folder / "campaign" / "poses.csv", folder / "f.csv"
    predict_run(folder / "run", poses, out)
    by_default = _places(out)
    assert np.linalg.norm(by_default - made.frames("tracker")[:, :3, 3], axis=1).mean() < 3e-4
    predict_run(folder / "run", poses, out, instrument="right")
    lengths = np.linalg.norm(_places(out), axis=1)
    assert np.abs(lengths - np.linalg.norm(made.frames("right")[:, :3, 3], axis=1)).mean() < 1e-4
    with pytest.raises(InvalidInput, match="did you mean 'right'"):
        predict_run(folder / "run", poses, out, instrument="rihgt")


def _places(path: Path) -> np.ndarray:
    table = read_table(path)
    return np.column_stack([table.numbers(f"{n}_mm") for n in "xyz"]) / 1000


def test_a_known_base_and_tool_serve_a_campaign_with_one_instrument(tmp_path: Path) -> None:
    made = watch(Plan(seed=5, poses=30, verify=8, kept_out=2, model=("axis1.yaw", "axis4.roll")), {"a": Watcher()})
    folder = write_watched(tmp_path, made)
    base, tool = (placement(T["a"]) | {"free": "none"} for T in (made.world_T_base, made.flange_T_tool))
    text = (folder / "campaign.yaml").read_text()
    start = text.index("instruments:")
    end = text.index("model:")
    stated = f"measurements: a.csv\nworld_T_base: {json.dumps(base)}\nflange_T_tool: {json.dumps(tool)}\n"
    (folder / "campaign.yaml").write_text(text[:start] + stated + text[end:])
    instrument = read_campaign(folder).instruments["measurements"]
    assert instrument.world.unknown == ()
    assert instrument.tool.unknown == ()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"same_tool": [["a", "c"]]}, "same_tool: there is no instrument 'c'"),
        ({"world_T_base": {"xyz_mm": [0, 0, 0]}}, "serves a campaign with one instrument"),
        ({"instruments": {"a": {"measurements": "a.csv", "mounted": "hand"}}}, "state 'mounted: world'"),
        ({"instruments": {"a": {"measurements": "a.csv", "body": "x"}}}, "there is no body 'x'"),
        (
            {"instruments": {"a": {"measurements": "a.csv", "world_T_base": {"free": ["x"]}}}},
            "world_T_base of instrument 'a': y is not free but has no value",
        ),
        (
            {
                "instruments": {
                    "a": {
                        "measurements": "a.csv",
                        "world_T_base": {"rpy_deg": [0, 90, 0], "free": ["x", "y", "z", "yaw"]},
                    }
                }
            },
            "roll and yaw turn about one line",
        ),
    ],
)
def test_contradictions_are_refused_in_one_sentence(tmp_path: Path, change: dict, sentence: str) -> None:
    made = watch(Plan(seed=5, poses=8, verify=2, kept_out=2), {"a": Watcher()})
    folder = write_watched(tmp_path, made, **change)
    with pytest.raises(InvalidInput, match=sentence):
        read_campaign(folder)


def test_an_instrument_whose_rows_share_no_pose_with_the_joint_angles_is_named(tmp_path: Path) -> None:
    made = watch(Plan(seed=5, poses=8, verify=2, kept_out=2), {"a": Watcher(), "b": Watcher()})
    folder = write_watched(tmp_path, made)
    (folder / "b.csv").write_text((folder / "b.csv").read_text().replace("\np", "\nx"))
    with pytest.raises(InvalidInput, match=r"instrument 'b': .*b\.csv, row 2: pose 'x001' is not in the table"):
        read_campaign(folder)


CORRECTION = """
import math

def straight(length, direction):
    # the count of a wheel of 40 mm, on which the distance is found by Newton's method
    r, e = 40.0, math.asin(direction[2])
    d = length
    for _ in range(5):
        counted = math.sqrt(d * d - r * r) + r * (math.asin(r / d) - e)
        d -= (counted - length) / (math.sqrt(d * d - r * r) / d)
    return d
"""


@pytest.mark.parametrize("way", ["free", "corrected", "left out"])
def test_a_pulley_in_the_model_gives_the_right_robot_and_one_left_out_an_alarm(tmp_path: Path, way: str) -> None:
    wrap = Effect("pulley_wrap", "wire", parameters={"radius_mm": 40.0})
    wire = Watcher("distances", poses="identify", sigma_mm=0.02, effects=(wrap,))
    model = ("axis2.pitch", "axis2.x", "axis3.pitch", "axis3.x", "axis5.pitch")
    plan = Plan(seed=3, poses=50, verify=10, model=model, kept_out=2, compliance=False)
    made = watch(plan, {"tracker": Watcher(poses="verify"), "wire": wire})
    entry = {
        "free": {"pulley": {"radius_mm": 25.0, "axis": [0, 0, 1], "free": "radius"}},
        "corrected": {"correction": "wheel:straight"},
        "left out": {},
    }[way]
    write_watched(tmp_path / "campaign", made, {"wire": entry}, diagnosis={"enabled": False})
    (tmp_path / "campaign" / "wheel.py").write_text(CORRECTION)
    run_campaign(tmp_path / "campaign", out=tmp_path / "run", until="verify")
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    error = result["verification"]["tools"]["0"]["mean"]
    log = (tmp_path / "run" / "log.txt").read_text()
    assert (error < 0.12) == (way != "left out")
    assert (way == "left out") == ("verify in 6D before driving" in log)
    assert ("corrected from outside in" in log) == (way == "corrected")
    if way == "free":
        radius = result["instruments"]["wire"]["wire"]["radius_mm"]
        assert abs(radius["value"] - 40.0) < 4.0 * radius["sigma"] < 4.0


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ({"correction": "wheel"}, "must be module:function"),
        ({"correction": "wheel:nothing"}, "cannot be loaded"),
        ({"correction": "nowhere:straight"}, "cannot be loaded"),
        ({"correction": "wheel:wrong"}, "gives nan"),
        ({"correction": "wheel:broken"}, "fails at"),
    ],
)
def test_a_correction_that_cannot_be_used_is_refused(tmp_path: Path, entry: dict, sentence: str) -> None:
    watchers = {"a": Watcher(), "wire": Watcher("distances")}
    made = watch(Plan(seed=5, poses=30, verify=2, kept_out=2, model=("axis2.x",)), watchers)
    folder = write_watched(tmp_path / "campaign", made, {"wire": entry})
    text = (
        "def wrong(length, direction):\n    return float('nan')\n\ndef broken(length, direction):\n    return 1 / 0\n"
    )
    (folder / "wheel.py").write_text(text)
    with pytest.raises(InvalidInput, match=sentence):
        run_campaign(folder, out=tmp_path / "run", until="identify")


def test_what_belongs_to_a_wire_is_refused_elsewhere(tmp_path: Path) -> None:
    made = watch(Plan(seed=5, poses=8, verify=2, kept_out=2), {"a": Watcher()})
    folder = write_watched(tmp_path, made, {"a": {"tension_N": 5.0}})
    with pytest.raises(InvalidInput, match="'tension_N' belongs to a wire's lengths"):
        read_campaign(folder)


@pytest.mark.parametrize(
    ("priors", "sentence"),
    [
        ({"axis9.x_mm": 0.3}, r"campaign.yaml, line \d+: 'axis9\.x_mm' is no length or angle of robot .*did you mean"),
        ({"axis2.x": 0.3}, r"'axis2\.x' is no length or angle of robot .*did you mean 'axis2\.x_mm'"),
        ({"lengths_mm": 0.0}, r"model\.priors\.lengths_mm: must be larger than zero"),
    ],
)
def test_priors_of_what_the_robot_does_not_have_are_refused(tmp_path: Path, priors: dict, sentence: str) -> None:
    made = watch(Plan(seed=5, poses=8, verify=2, kept_out=2), {"a": Watcher()})
    with pytest.raises(InvalidInput, match=sentence):
        read_campaign(write_watched(tmp_path, made, model={"priors": priors}))


def test_priors_hold_for_all_lengths_and_single_ones(tmp_path: Path) -> None:
    made = watch(Plan(seed=5, poses=8, verify=2, kept_out=2), {"a": Watcher()})
    stated = {"axis3.x_mm": 0.1, "lengths_mm": 0.5, "axis2.pitch_deg": 0.02}
    campaign = read_campaign(write_watched(tmp_path, made, model={"priors": stated}))
    priors = options_of(campaign, stated=True).priors
    assert priors["axis3.x"] == pytest.approx(1e-4)
    assert priors["axis4.z"] == pytest.approx(5e-4)
    assert priors["axis2.pitch"] == pytest.approx(np.radians(0.02))
    assert "axis3.pitch" not in priors

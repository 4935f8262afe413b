"""Several instruments diagnosed: a fault of a wire is put right; what one shows and another contradicts is its own."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from fixtures.effects import Effect
from fixtures.instruments import Watched, Watcher, watch, write_watched
from fixtures.plan import Plan
from pipeline.runner import run_campaign

MODEL = ("axis2.pitch", "axis2.x", "axis3.pitch", "axis3.x", "axis5.pitch")
PLAN = Plan(seed=3, poses=50, verify=8, model=MODEL, kept_out=2, compliance=False)


@pytest.fixture(scope="module")
def sagging(tmp_path_factory):  # type: ignore[no-untyped-def]
    """A wire that sags identifies, a tracker verifies."""
    folder = tmp_path_factory.mktemp("sag")
    sag = Effect("wire_sag", "wire", parameters={"g_per_m": 12.0, "tension_N": 8.0})
    wire = Watcher("distances", poses="identify", sigma_mm=0.02, effects=(sag,))
    made = watch(PLAN, {"tracker": Watcher(poses="verify"), "wire": wire})
    write_watched(folder / "campaign", made, {"wire": {"tension_N": 8.0}})
    run_campaign(folder / "campaign", out=folder / "run")
    return folder / "run"


def test_a_sagging_wire_is_named_and_the_robot_put_right(sagging: Path) -> None:
    content = json.loads((sagging / "diagnosis.json").read_text())
    assert [(c["cause"], c["stage"], c["instrument"]) for c in content["causes"]] == [("wire_sag", "wire", "wire")]
    found = content["causes"][0]
    assert abs(found["parameters"]["g_per_m"] - 12.0) < 5 * found["sigma"]["g_per_m"] < 1.0
    assert content["instruments"]["wire"]["mismatch"]
    result = json.loads((sagging / "result.json").read_text())
    wire = result["instruments"]["wire"]["wire"]["g_per_m"]
    assert abs(wire["value"] - 12.0) < 4 * wire["sigma"]
    assert result["verification"]["tools"]["0"]["mean"] < 0.12
    assert content["heldout_mm"]["after"] < 0.3 * content["heldout_mm"]["before"]
    assert (sagging / "report.html").is_file()


def test_a_scale_is_listed_as_not_to_be_told(sagging: Path) -> None:
    content = json.loads((sagging / "diagnosis.json").read_text())
    (sentence,) = content["not_told"]
    assert "scale of wire 'wire' cannot be told" in sentence


@pytest.mark.slow
def test_what_one_instrument_shows_and_another_contradicts_belongs_to_it(tmp_path: Path) -> None:
    lag = Effect("hysteresis", "axis1", None, {"width_deg": 0.06})
    trackers = {"sound": Watcher(poses="identify"), "odd": Watcher(poses="identify")}
    whole, lagging = watch(PLAN, trackers), watch(replace(PLAN, effects=(lag,)), trackers)
    made = Watched(
        whole.truth,
        whole.rows,
        whole.world_T_base,
        whole.flange_T_tool,
        {"sound": whole.tables["sound"], "odd": lagging.tables["odd"]},
    )
    run_campaign(write_watched(tmp_path / "campaign", made), out=tmp_path / "run", until="diagnose")
    content = json.loads((tmp_path / "run" / "diagnosis.json").read_text())
    causes = [c for c in content["causes"] if c["where"] == "axis1"]
    assert causes
    assert {(c["instrument"], c["stage"]) for c in causes} == {("odd", "camera")}
    assert causes[0]["contradicting"] == ["sound"]
    assert "belongs to that instrument" in causes[0]["statement"]


@pytest.mark.slow
def test_what_both_instruments_show_is_the_robot(tmp_path: Path) -> None:
    lag = Effect("hysteresis", "axis1", None, {"width_deg": 0.06})
    trackers = {"one": Watcher(poses="identify"), "two": Watcher(poses="identify")}
    made = watch(replace(PLAN, effects=(lag,)), trackers)
    run_campaign(write_watched(tmp_path / "campaign", made), out=tmp_path / "run", until="diagnose")
    content = json.loads((tmp_path / "run" / "diagnosis.json").read_text())
    (cause,) = content["causes"]
    # without a load about a vertical axis the two are the same
    assert cause["cause"] in ("backlash", "hysteresis")
    assert (cause["stage"], cause["where"]) == ("robot", "axis1")
    assert len(cause["agreeing"]) == 1
    assert cause["contradicting"] == []


@pytest.mark.slow
def test_lengths_with_priors_carry_the_scale_of_a_wire(tmp_path: Path) -> None:
    scale = Effect("wire_scale", "wire", parameters={"ppm": 3000.0})
    wire = Watcher("distances", poses="identify", sigma_mm=0.02, effects=(scale,))
    made = watch(replace(PLAN, poses=80), {"tracker": Watcher(poses="verify"), "wire": wire})
    model = {"parameters": list(MODEL), "priors": {"lengths_mm": 0.6}}
    write_watched(tmp_path / "campaign", made, model=model)
    run_campaign(tmp_path / "campaign", out=tmp_path / "run", until="diagnose")
    content = json.loads((tmp_path / "run" / "diagnosis.json").read_text())
    assert not content["not_told"]
    # the scale shows as a length that the model holds, too: beside the scale that one does not pay
    (cause,) = [c for c in content["causes"] if c["in_force"]]
    assert (cause["cause"], cause["instrument"]) == ("wire_scale", "wire")
    assert abs(cause["parameters"]["ppm"] - 3000.0) < 3.0 * cause["sigma"]["ppm"]
    assert content["heldout_mm"]["after"] < 0.7 * content["heldout_mm"]["before"]

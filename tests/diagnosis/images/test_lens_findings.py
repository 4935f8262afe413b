"""Lens groups that a camera's file lacks, swapped targets, and recorded data with hidden distortion."""

import contextlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.adjusted_images import findings_of
from pipeline.campaign_reader import read_campaign
from pipeline.runs import Run
from robcal.diagnosis.images.diagnosis import ImageFinding
from robcal.diagnosis.images.lens_findings import beyond_lenses, station_findings, survey_findings
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.station.contradictions import CAMERA_MOVED, LENS_AFFINITY, LENS_TANGENTIAL, TARGET_SHIFTED
from robcal.photogrammetry.station.network import StationCause
from robcal.physics.library import kinds
from tests.diagnosis.image_scenes import station, survey

REAL = Path(__file__).parents[3] / "shared" / "real"


@pytest.mark.parametrize("cause", ["lens_radial", "lens_tangential", "lens_affinity"])
def test_survey_names_the_group_that_its_file_lacks(cause):
    done, file = survey(cause, snr=9.0, seed=11)
    found = survey_findings(done.network, file, "survey")
    assert [f.name for f in found] == [cause]
    assert found[0].p_value < 1e-4
    assert not survey_findings(done.network, None, "survey")  # without start values that is simply the job


def test_complete_file_lacks_nothing():
    done, file = survey(seed=12)
    assert survey_findings(done.network, file, "survey") == ()


def test_station_names_the_camera():
    scene = station("lens_tangential", snr=12.0, seed=13)
    (found,) = station_findings(scene.orientation, scene.names)
    assert (found.name, found.where) == ("lens_tangential", scene.effects[0].where)
    assert set(found.parameters) == set(found.sigma) == {"p1", "p2"}


def test_two_targets_in_each_others_place_are_swapped():
    scene = station(seed=14)
    body = scene.given
    way = body.points[3] - body.points[1]
    small = np.eye(3) * 1e-12
    one = StationCause(TARGET_SHIFTED, str(body.ids[1]), None, None, way, small, 1e4, 3, "")
    other = StationCause(TARGET_SHIFTED, str(body.ids[3]), None, None, -way + 1e-5, small, 1e4, 3, "")
    far = replace(other, estimate=0.5 * way)
    swapped = list(station_findings(replace(scene.orientation, evidence=(one, other)), scene.names, body))
    assert [(f.name, f.where, f.parameters) for f in swapped] == [
        ("target_swapped", str(body.ids[1]), {"with": int(body.ids[3])})
    ]
    apart = list(station_findings(replace(scene.orientation, evidence=(one, far)), scene.names, body))
    assert [f.name for f in apart] == ["target_shifted", "target_shifted"]


def test_small_evidence_is_none_where_images_share_errors():
    scene = station(seed=15)
    move = StationCause(CAMERA_MOVED, "right", None, 5, np.full(6, 1e-4), np.eye(6) * 1e-10, 85.0, 6, "")
    orientation = replace(scene.orientation, evidence=(move,))
    assert [f.name for f in station_findings(orientation, scene.names)] == ["camera_moved"]
    assert not list(station_findings(orientation, scene.names, None, {"camera_moved": 5.0}))


def _diagnosed(name: str, tmp_path: Path):
    from pipeline.cli import main

    with pytest.MonkeyPatch.context() as patch:
        command = ["pipeline", "run", str(REAL / name), "--out", str(tmp_path), "--until", "diagnose", "-q"]
        patch.setattr("sys.argv", command)
        with contextlib.suppress(SystemExit):
            main()
    return json.loads((tmp_path / "diagnosis.json").read_text(encoding="utf-8"))


@pytest.mark.skipif(not (REAL / "dbat_camcal").is_dir(), reason="recorded data are not beside this checkout")
def test_recorded_sheet_radial_then_tangential(tmp_path):
    reported = _diagnosed("dbat_camcal", tmp_path)
    causes = [c["cause"] for c in reported["causes"]]
    assert causes[:2] == ["lens_radial", "lens_tangential"]
    assert set(causes) <= {"lens_radial", "lens_tangential", "lens_affinity"}
    assert findings_of(read_campaign(REAL / "dbat_camcal"), Run(tmp_path)).findings[0].heldout_px[1] < 0.17


@pytest.mark.skipif(not (REAL / "opencv_stereo_chess").is_dir(), reason="recorded data are not beside this checkout")
def test_recorded_stereo_pairs_have_distorted_lenses_and_nothing_that_moved(tmp_path):
    reported = _diagnosed("opencv_stereo_chess", tmp_path)
    found = [(c["cause"], c["where"]) for c in reported["causes"]]
    assert set(found[:2]) == {("lens_radial", "left"), ("lens_radial", "right")}
    assert {cause for cause, _ in found} <= {"lens_radial", "lens_tangential", "lens_affinity"}


def test_lens_terms_that_no_lens_has_are_refraction() -> None:
    camera = Camera(1280, 1024, 6000.0, 6020.0, 640.0, 512.0, p1=0.0, p2=0.03)

    def finding(cause: str, where: str, parameters: dict[str, object], p_value: float) -> ImageFinding:
        return ImageFinding(kinds()[cause], where, None, parameters, {}, p_value, (), (1.0, 0.8), cause)

    reported = [
        finding("lens_tangential", "a", {"p1": 0.0, "p2": 0.03}, 1e-20),
        finding("lens_affinity", "a", {"fy_minus_fx_px": 20.0}, 1e-9),
        finding("lens_tangential", "b", {"p1": 0.0, "p2": 0.03}, 1e-20),
        finding("refraction", "b", {"index": 1.3}, 1e-6),
        finding("lens_radial", "b", {"k1": -0.1}, 1e-30),
    ]
    found = beyond_lenses(reported, {"a": camera, "b": camera})
    assert [(f.name, f.where) for f in found] == [("refraction", "b"), ("refraction", "a"), ("lens_radial", "b")]
    assert found[0].rivals == ((LENS_TANGENTIAL, "b"),)
    assert found[0].parameters == {"index": 1.3}
    assert set(found[1].rivals) == {(LENS_TANGENTIAL, "a"), (LENS_AFFINITY, "a")}
    assert "p2 = 0.03" in str(found[1].parameters["term"])


def test_decentring_of_a_usual_lens_stays_a_lens_term() -> None:
    camera = Camera(1280, 1024, 1500.0, 1500.6, 640.0, 512.0, p1=1e-3, p2=0.0)
    reported = [ImageFinding(LENS_TANGENTIAL, "a", None, {"p1": 1e-3}, {}, 1e-20, (), (1.0, 0.8), "")]
    assert beyond_lenses(reported, {"a": camera}) == tuple(reported)

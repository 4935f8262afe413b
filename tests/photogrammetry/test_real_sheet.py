"""Real measurements: the calibration sheet of DBAT's demonstration project "camcal" (21 images, Olympus C4040Z).

Skipped where the recordings are not beside the repository. Expected values: README of the data set (own and published
adjustments: sigma0 0.155 .. 0.1615 px, redundancy 3725).
"""

import csv
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import yaml

from robcal.photogrammetry.bundle.settings import AdjustSettings
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.network import Lengths
from robcal.photogrammetry.survey.survey import BodyTarget, SurveyImage, SurveySettings, survey_body

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "real" / "dbat_camcal"
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="recordings dbat_camcal are not there")

SIZE = (2272, 1704)
CORNERS = (1001, 1002, 1003, 1004)


def images() -> list[SurveyImage]:
    rows: dict[str, list[dict[str, str]]] = defaultdict(list)
    with (FOLDER / "survey" / "observations.csv").open() as file:
        for row in csv.DictReader(file):
            rows[row["image"]].append(row)
    return [
        SurveyImage(
            name,
            marks=(
                np.array([int(r["target"]) for r in some]),
                np.array([[float(r["x_px"]), float(r["y_px"])] for r in some]),
                np.array([np.eye(2) * float(r["sigma_px"]) ** 2 for r in some]),
            ),
        )
        for name, some in rows.items()
    ]


def targets() -> list[BodyTarget]:
    out = []
    for t in yaml.safe_load((FOLDER / "sheet.yaml").read_text())["targets"]:
        xyz = None if t["xyz_mm"] is None else tuple(v / 1e3 for v in t["xyz_mm"])
        out.append(BodyTarget(t["id"], t["code"], None, xyz, None))
    return out


def pinhole() -> Camera:
    c = yaml.safe_load((FOLDER / "camera.yaml").read_text())
    return Camera(c["width"], c["height"], c["fx"], c["fy"], c["cx"], c["cy"])


def test_published_sigma0_and_redundancy() -> None:
    everything = SurveySettings(adjust=AdjustSettings(snooping=False))
    net = survey_body(images(), targets(), size=SIZE, camera=pinhole(), datum=CORNERS, settings=everything).network
    assert net.redundancy_total == 3725
    assert 0.153 < net.sigma0_px < 0.162
    c = net.camera
    assert abs(c.fx - 2335.9) < 0.5
    assert abs(c.fy / c.fx - 1.0004) < 5e-5
    np.testing.assert_allclose([c.cx, c.cy], [1132.6, 818.2], atol=0.3)
    off = np.abs(np.array([c.k1, c.k2, c.k3]) - [-0.2527, 0.3086, -0.043])
    assert (off < [5e-4, 2e-3, 5e-3]).all()


def test_without_start_values_the_same() -> None:
    given = survey_body(images(), targets(), size=SIZE, camera=pinhole(), datum=CORNERS)
    none = survey_body(images(), targets(), size=SIZE, datum=CORNERS)
    np.testing.assert_allclose(given.network.camera.vector, none.network.camera.vector, rtol=1e-5, atol=1e-6)
    assert len(given.network.rejected) < 10


def test_coordinates_agree_with_photomodelers() -> None:
    net = survey_body(images(), targets(), size=SIZE, camera=pinhole(), datum=CORNERS).network
    with (FOLDER / "reference_points_photomodeler.csv").open() as file:
        reference = {int(r["target"]): [float(r[f"{a}_mm"]) for a in "xyz"] for r in csv.DictReader(file)}
    common = [i for i in net.ids.tolist() if i in reference]
    difference = 1e3 * net.points[net.index_of(common)] - np.array([reference[i] for i in common])
    assert len(common) >= 95
    assert np.sqrt(np.mean(difference**2)) < 0.09
    assert np.abs(difference).max() < 0.25


def test_free_network_with_one_side_as_scale_bar() -> None:
    bar = Lengths([[1001, 1002]], [1.0], [5e-5])
    pairs = [[1003, 1004], [1001, 1003], [1002, 1004], [1001, 1004], [1002, 1003]]
    checks = Lengths(pairs, [1.0, 1.0, 1.0, 1.4142136, 1.4142136], [np.nan] * 5)
    result = survey_body(images(), targets(), size=SIZE, camera=pinhole(), scale_bars=bar, check_lengths=checks)
    assert 0.12 < result.network.sigma0_px < 0.16
    # the "square" of a printed sheet: nominal to a part in a thousand, not better
    assert max(abs(c.error) for c in result.network.check_lengths) < 1.2e-3

"""Recorded stereo pairs of a chessboard (OpenCV's samples): from pinhole start values to the known figures.

Known (computed independently, README of the data): RMS per point 0.234 px left, 0.236 px right, 0.257 px together;
focal lengths 532 and 535 px; baseline 82.89 mm. The lens terms are not in the start values and must be found.
"""

import csv
from pathlib import Path

import numpy as np
import pytest
import yaml

from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.measure.frames import measure_frames
from robcal.photogrammetry.measure.points import measure_points
from robcal.photogrammetry.station.network import StationMarks
from robcal.photogrammetry.station.orientation import orient_station

DATA = Path(__file__).parents[3] / "shared" / "real" / "opencv_stereo_chess"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="recorded data are not beside this checkout")


def _load():
    targets = yaml.safe_load((DATA / "board.yaml").read_text())["targets"]
    body = Body("board", np.array([t["id"] for t in targets]), 1e-3 * np.array([t["xyz_mm"] for t in targets]))
    marks, cameras = {}, {}
    tables = {name: list(csv.DictReader((DATA / "station" / f"{name}.csv").open())) for name in ("left", "right")}
    images = sorted({row["image"] for table in tables.values() for row in table})
    for name, table in tables.items():
        marks[name] = StationMarks(
            np.array([images.index(row["image"]) for row in table]),
            np.array([int(row["target"]) for row in table]),
            np.array([[float(row["x_px"]), float(row["y_px"])] for row in table]),
            np.tile(np.eye(2) * 0.1**2, (len(table), 1, 1)),
        )
        y = yaml.safe_load((DATA / f"{name}.yaml").read_text())
        numbers = ("width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
        cameras[name] = Camera(*(y[k] for k in numbers))
    return body, marks, cameras


@pytest.mark.parametrize("files", [True, False])
def test_chessboard(files):
    body, marks, cameras = _load()
    o = orient_station(marks, body, cameras if files else dict.fromkeys(marks), dict.fromkeys(marks, (640, 480)))
    per_point = o.rms_px * np.sqrt(2.0)
    assert per_point < 0.257
    assert len(o.rejected) < 0.05 * 1404
    assert abs(o.cameras[0].fx - 532) < 5
    assert abs(o.cameras[1].fx - 535) < 5
    baseline = np.linalg.norm(o.world_T_camera["right"][:3, 3])
    assert abs(baseline - 0.08289) < 0.0002
    radial = {e.where for e in o.evidence if e.name == "lens_radial"}
    assert radial == ({"left", "right"} if files else set())
    f = measure_frames(measure_points(o, marks), body)
    assert len(f.pose) == 13
    assert not f.recurring.targets

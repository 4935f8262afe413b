"""Tables of measurements: their kinds, units, covariances, and what is refused with its row."""

from pathlib import Path

import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.files.measurement_tables import read_measurements, unmeasured

POSES = ("a", "b")
POINT = "pose,target,x_mm,y_mm,z_mm"


def table(folder: Path, text: str, name: str = "table.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("text", "name", "kind", "shape"),
    [
        (f"{POINT}\na,1,1,2,3\nb,1,1,2,4\n", "table.csv", "points", (2, 3)),
        (f"{POINT},cycle\na,1,1,2,3,1\nb,1,1,2,4,1\n", "table.csv", "sensor_points", (2, 3)),
        (f"{POINT}\na,1,1,2,3\nb,1,1,2,4\n", "sensor.csv", "sensor_points", (2, 3)),
        (
            "pose,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg\na,1,2,3,0,0,90\nb,1,2,3,0,0,0\n",
            "t.csv",
            "frames",
            (2, 4, 4),
        ),
        ("pose,distance_mm\na,1000\nb,1001\n", "t.csv", "distances", (2,)),
    ],
)
def test_columns_say_the_kind(tmp_path: Path, text: str, name: str, kind: str, shape: tuple[int, ...]) -> None:
    found = read_measurements(table(tmp_path, text, name), POSES)
    assert found.kind == kind
    assert found.values.shape == shape
    assert found.covariance is None


def test_units_and_covariances(tmp_path: Path) -> None:
    head = f"{POINT},sxx_mm2,sxy_mm2,sxz_mm2,syy_mm2,syz_mm2,szz_mm2"
    found = read_measurements(table(tmp_path, f"{head}\nb,7,1000,0,0,4,1,0,9,0,16\n"), POSES)
    assert found.values[0] == pytest.approx([1.0, 0.0, 0.0])
    assert found.covariance is not None
    assert found.covariance[0] == pytest.approx(1e-6 * np.array([[4, 1, 0], [1, 9, 0], [0, 0, 16]]))
    assert found.pose.tolist() == [1]
    assert unmeasured([found], POSES) == ["1 poses have no measurement in table.csv (a)"]
    plain = read_measurements(table(tmp_path, f"{POINT},sigma_mm\na,7,0,0,1,2\nb,7,0,0,2,2\n"), POSES)
    assert plain.covariance == pytest.approx(np.tile(4e-6 * np.eye(3), (2, 1, 1)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("pose,length\na,1\n", "of no known kind"),
        (f"{POINT}\nc,1,1,2,3\n", "row 2.*pose 'c' is not in the table of poses"),
        (f"{POINT}\na,1,1,2,3\na,1,1,2,3\n", "row 3"),
        (f"{POINT}\na,one,1,2,3\n", "not a whole number"),
        (f"{POINT}\na,1,x,2,3\n", "row 2"),
        (f"{POINT},sxx_mm2\na,1,1,2,3,1\n", "sxy_mm2"),
        (f"{POINT}\n", "lists no measurements"),
        ("pose,distance_mm\na,-5\n", "row 2"),
    ],
)
def test_faults_are_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        read_measurements(table(tmp_path, text), POSES)

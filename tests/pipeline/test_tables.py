from pathlib import Path

import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.files.frame_tables import six_covariance, twist_covariance
from robcal.files.tables import read_table, write_table
from robcal.transforms import frame_from_xyzrpy, xyzrpy_from_frame


def table(folder: Path, content: str | bytes) -> Path:
    path = folder / "t.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def test_byte_order_mark_crlf_blanks_and_blank_lines(tmp_path: Path) -> None:
    read = read_table(table(tmp_path, "\ufeffpose , x_mm\r\np1, 1.5\r\n\r\np2,2\r\n".encode()))
    assert read.texts("pose") == ("p1", "p2")
    np.testing.assert_array_equal(read.numbers("x_mm"), [1.5, 2.0])
    assert list(read.rows) == [2, 4]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("pose,x_mm\np1,1\np2,nan\n", ["row 3", "x_mm is missing"]),
        ("pose,x_mm\np1,\n", ["row 2", "x_mm is missing"]),
        ("pose,x_mm\np1,abc\n", ["row 2", "'abc', not a number"]),
        ("pose,x_mm\np1,inf\n", ["row 2", "infinite"]),
        ("pose,y_mm\np1,1\n", ["row 1", "column 'x_mm' is missing"]),
        ("Pose,X_mm\np1,1\n", ["row 1", "did you mean"]),
    ],
)
def test_bad_cells_name_file_row_and_remedy(tmp_path: Path, content: str, words: list[str]) -> None:
    with pytest.raises(InvalidInput) as error:
        read_table(table(tmp_path, content)).numbers("x_mm")
    for word in ["t.csv", *words]:
        assert word in str(error.value)


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("pose;x_mm\np1;1,5\n", "separated by semicolons"),
        ("pose\tx_mm\np1\t1\n", "separated by tabs"),
        ("pose,x_mm,x_mm\np1,1,2\n", "stands twice"),
        ("pose,x_mm\np1,1,5\n", "row 2: has 3 cells where the header has 2"),
        ("pose,x_mm\np1\n", "row 2: has 1 cells"),
        ("", "is empty"),
        ("pose,,x\n1,2,3\n", "column 2 has no name"),
        (b"\xff\xfep\x00o\x00", "UTF-16"),
        (b"pose\x00\x01,\n", "not a text file"),
        ("pose,näme\np1,ä\n".encode("latin-1"), "not UTF-8"),
        ('pose,x\n"p1,1\n', "not a CSV table"),
    ],
)
def test_tables_of_another_kind_are_refused(tmp_path: Path, content: str | bytes, word: str) -> None:
    with pytest.raises(InvalidInput, match=r"t\.csv") as error:
        read_table(table(tmp_path, content))
    assert word in str(error.value)


def test_duplicates_name_both_rows(tmp_path: Path) -> None:
    read = read_table(table(tmp_path, "pose,target\np1,1\np1,2\np1,1\n"))
    with pytest.raises(InvalidInput, match=r"row 4: pose p1, target 1 stands twice \(first in row 2"):
        read.unique(["pose", "target"])


def test_round_trip(tmp_path: Path) -> None:
    write_table(tmp_path / "o.csv", {"pose": ["a", "b, c"], "x": [0.1, 1 / 3]})
    read = read_table(tmp_path / "o.csv")
    assert read.texts("pose") == ("a", "b, c")
    np.testing.assert_allclose(read.numbers("x"), [0.1, 1 / 3], rtol=1e-11)


@pytest.mark.parametrize("pitch", [90.0, -90.0, 89.99, 88.0, 60.0])
def test_covariance_of_frames_at_any_pitch(pitch: float) -> None:
    """Isotropic turns come back from their six numbers; at the lock they do so by convention."""
    six = np.array([[1.0, 2.0, 3.0, *np.radians([20.0, pitch, -35.0])]])
    T = frame_from_xyzrpy(six)
    C = np.diag([1e-4**2] * 3 + [1e-4**2] * 3)[None]
    back = twist_covariance(xyzrpy_from_frame(T), six_covariance(T, C))
    assert np.allclose(back, C, rtol=1e-6, atol=1e-12)
    stated = np.diag([6e-5**2] * 3 + [1e-4**2] * 3)[None]
    values = np.linalg.eigvalsh(twist_covariance(six, stated)[0])
    assert values[0] > 0
    assert values[-1] < 4e-8

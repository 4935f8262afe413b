"""What is said of boards whose files are wrong or leave something open."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.stages.detect import board_notes
from pipeline.stages.hand_eye import _shape_notes
from robcal.files.body_file import read_body
from robcal.photogrammetry.core.bodies import Body

HEAD = "format: robcal/body-1\nboard: {kind: circles, columns: 5, rows: 4, spacing_mm: 20"


@pytest.mark.parametrize(("more", "told"), [("}", True), (", diameter_mm: 9}", False)])
def test_circles_without_a_diameter_are_told(tmp_path: Path, more: str, told: bool) -> None:
    (tmp_path / "board.yaml").write_text(HEAD + more + "\n")
    notes = board_notes(read_body(tmp_path / "board.yaml"))
    assert any("state no diameter_mm" in note for note in notes) == told


def test_a_board_of_another_size_than_stated_tells_how_far_its_origin_is_off() -> None:
    points = np.array([[0.02, 0.02, 0.0], [0.1, 0.02, 0.0], [0.02, 0.08, 0.0], [0.1, 0.08, 0.0]])
    found = SimpleNamespace(shape={"scale": 0.004}, shape_sigma={"scale": 1e-4})
    notes = _shape_notes(found, Body("board", np.arange(4), points))  # type: ignore[arg-type]
    assert "0.400 +- 0.010 per cent larger" in notes[0]
    # the middle lies 78 mm from the origin
    assert "lies 0.31 mm from the corner of the real board: run again with the corrected file" in notes[1]

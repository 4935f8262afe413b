"""The scripts in examples/ run and come to the right result."""

import numpy as np
import pytest

from examples import arrays_to_c, diagnosis, plate_from_photographs, robot_from_tracker
from fixtures.demo import demo_plan


def test_robot_from_tracker_frames(capsys: pytest.CaptureFixture[str]) -> None:
    assert robot_from_tracker.main() < 0.15e-3
    assert "kept out" in capsys.readouterr().out


def test_diagnosis() -> None:
    (sentence,) = diagnosis.main()
    assert "backlash" in sentence


def test_own_arrays_to_c() -> None:
    source = arrays_to_c.main()
    assert source.header
    assert source.source


def test_plate_from_photographs() -> None:
    network = plate_from_photographs.main().network
    plate = demo_plan().surveys[0].body
    coded = np.asarray(plate.coded, dtype=bool)  # the others get their ids from the survey
    ids, true, found = np.intersect1d(plate.ids[coded], network.ids, return_indices=True)
    assert len(ids) == 12
    spans = [np.linalg.norm(p[:, None] - p, axis=2) for p in (plate.points[coded][true], network.points[found])]
    assert np.abs(spans[1] - spans[0]).max() < 5e-5

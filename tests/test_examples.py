"""The scripts in examples/ run and come to the right result."""

import pytest

from examples import arrays_to_c, diagnosis, robot_from_tracker


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

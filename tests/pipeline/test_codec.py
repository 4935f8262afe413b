from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pipeline import codec
from pipeline.runs import StageRecord
from robcal.imaging.detections import Reason
from robcal.robot.model import Frame, RobotModel


def test_every_kind_of_value_comes_back_with_its_type(tmp_path: Path) -> None:
    robot = RobotModel("r", (Frame("a", "z"), Frame("flange")), parameters={"a.x": 1e-3})
    value = {
        "numbers": (1, 2.5, float("inf"), True, None, "text"),
        "arrays": [np.arange(6).reshape(2, 3), np.array([True, False]), np.array(["a", "b"])],
        3: frozenset({1, 2}),
        "enum": Reason.BORDER,
        "path": Path("a/b"),
        "robot": robot,
        "record": StageRecord("detect", "k", {"a": "b"}, {}),
    }
    codec.save(tmp_path / "v.npz", value)
    back = codec.load(tmp_path / "v.npz")
    assert back["numbers"] == value["numbers"]
    np.testing.assert_array_equal(back["arrays"][0], value["arrays"][0])
    assert back["arrays"][1].dtype == bool
    assert back[3] == frozenset({1, 2})
    assert back["enum"] is Reason.BORDER
    assert back["path"] == Path("a/b")
    assert back["robot"] == robot
    assert back["record"] == value["record"]
    assert not back["arrays"][0].flags.writeable


def test_nan_and_equal_bytes_for_equal_values() -> None:
    value = {"a": np.linspace(0, 1, 5), "b": float("nan")}
    assert codec.dumps(value) == codec.dumps(value)


def test_foreign_types_are_neither_stored_nor_loaded(tmp_path: Path) -> None:
    @dataclass
    class Foreign:
        a: int

    with pytest.raises(TypeError, match="not a type of this project"):
        codec.dumps(Foreign(1))
    hostile = {"$": "dataclass", "class": "subprocess:Popen", "fields": {"args": "true"}}
    with pytest.raises(codec.StaleCache):
        codec.decode(hostile, {})


def test_damaged_files_are_told(tmp_path: Path) -> None:
    path = tmp_path / "v.npz"
    codec.save(path, {"a": np.arange(100)})
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(codec.StaleCache, match="cannot be read back"):
        codec.load(path)

"""JSON files, and work in processes."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from pipeline.json_io import fingerprint, plain, read_json, write_json
from pipeline.parallel import THREAD_VARIABLES, in_processes
from robcal.errors import InvalidInput


def test_numpy_and_infinities_become_json(tmp_path: Path) -> None:
    data = {"a": np.float64(2.5), "b": np.arange(3), "c": float("nan"), "d": {1: (np.inf, "x")}, "e": tmp_path}
    write_json(tmp_path / "x.json", data)
    assert read_json(tmp_path / "x.json") == {
        "a": 2.5,
        "b": [0, 1, 2],
        "c": None,
        "d": {"1": [None, "x"]},
        "e": str(tmp_path),
    }


def test_names_in_another_encoding_survive(tmp_path: Path) -> None:
    name = b"\xff.png".decode(errors="surrogateescape")
    write_json(tmp_path / "x.json", {"image": name})
    assert read_json(tmp_path / "x.json")["image"] == name


@pytest.mark.parametrize(("content", "words"), [(None, "no such file"), ("{", "damaged"), ("[1]", "damaged")])
def test_what_cannot_be_read_says_what_to_do(tmp_path: Path, content: str | None, words: str) -> None:
    path = tmp_path / "x.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(InvalidInput, match=rf"{words}.*run the campaign"):
        read_json(path)


def test_fingerprints_differ_with_data_and_not_with_order_of_keys() -> None:
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})
    assert fingerprint({"a": 1}) != fingerprint({"a": 2})
    assert json.dumps(plain({"a": np.int64(3)})) == '{"a": 3}'


def square(value: int) -> tuple[int, str | None]:
    return value * value, os.environ.get("OMP_NUM_THREADS")


@pytest.mark.parametrize("workers", [1, 2])
def test_processes_keep_the_order_and_the_environment(workers: int) -> None:
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    found = list(in_processes(square, range(5), workers))
    assert [value for value, _ in found] == [0, 1, 4, 9, 16]
    assert {name: os.environ.get(name) for name in THREAD_VARIABLES} == before
    if workers > 1:
        assert {threads for _, threads in found} == {"1"}

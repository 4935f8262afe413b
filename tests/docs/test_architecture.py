"""docs/architecture.md: its paths follow the imports, and its picture can be drawn from them."""

import re
from pathlib import Path

import grimp
import pytest

from tools.architecture import PICTURE, arrows_of, drawn, layers, reduced

PAGE = (Path(__file__).parents[2] / "docs" / "architecture.md").read_text(encoding="utf-8")
MOST = {"an ellipse centre": 33, "a compliance": 10}
"""Modules that a reader passes; fewer are better."""


@pytest.fixture(scope="module")
def graph() -> grimp.ImportGraph:
    return grimp.build_graph("robcal", "pipeline", cache_dir=None)


@pytest.mark.parametrize("what", MOST)
def test_every_module_of_a_path_is_linked_to_one_before_it(graph: grimp.ImportGraph, what: str) -> None:
    text = PAGE.split(f"<!-- path of {what} -->")[1].split("##")[0]
    path = re.findall(r"^\d+\. `([\w.]+)`", text, re.MULTILINE)
    assert 5 < len(path) <= MOST[what]
    for k, module in enumerate(path):
        assert module in graph.modules, module
        linked = graph.find_modules_directly_imported_by(module) | graph.find_modules_that_directly_import(module)
        assert k == 0 or linked & set(path[:k]), module


def test_the_picture_shows_every_layer() -> None:
    svg = drawn()
    assert all(f">{name}</text>" in svg for row in layers() for name in row)
    assert arrows_of(svg)
    assert PICTURE.is_file()


def test_arrows_that_follow_are_left_out() -> None:
    arrows = {("a", "b"): 1, ("b", "c"): 2, ("a", "c"): 3, ("a", "d"): 1}
    assert reduced(arrows) == {("a", "b"), ("b", "c"), ("a", "d")}


def test_every_package_has_a_row() -> None:
    missing = [name for (name,) in layers() if _is_package(name) and f"| `{name}` |" not in PAGE]
    assert not missing


def _is_package(name: str) -> bool:
    return (Path(__file__).parents[2] / name.replace(".", "/")).is_dir()

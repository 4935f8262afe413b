"""What the pages on extending show works, and the files and links that pages name exist."""

import re
from pathlib import Path

import numpy as np
import pytest

from robcal.physics.site import RobotSite
from robcal.robot.model import Frame, RobotModel

ROOT = Path(__file__).parents[2]
PAGES = [*sorted((ROOT / "docs").rglob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]


def test_the_example_of_a_cause_acts_where_it_can_show() -> None:
    page = (ROOT / "docs" / "extending" / "cause.md").read_text(encoding="utf-8")
    found = re.search(r"```python\n(.*?)```", page, re.DOTALL)
    assert found is not None
    names: dict = {}
    exec(found[1], names)
    frames = (Frame("axis1", "z"), Frame("axis2", "y", xyz=(0.3, 0.0, 0.0)), Frame("flange", None))
    model = RobotModel(name="two axes", frames=frames)
    variables = {
        "q1": np.arange(5.0),
        "q2": np.arange(5.0),
        "temp_motor1_c": np.linspace(20, 30, 5),
        "temp_motor2_c": np.full(5, 20.0),
    }
    site = RobotSite(model, variables, frozenset(), frozenset())
    causes = [cause for entry in names["ENTRIES"] for cause in entry.on_robot(site)]
    assert [cause.where for cause in causes] == ["axis1"]
    (law,) = causes[0].laws({})
    assert law.value(variables) == pytest.approx(variables["temp_motor1_c"])
    assert causes[0].describe(causes[0].report(np.array([1e-6]), {})).startswith("Axis 1 turns by 0.0001 deg")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    missing = [link for link in links if not (page.parent / link).exists()]
    assert not missing


@pytest.mark.parametrize("page", sorted((ROOT / "docs" / "extending").glob("*.md")), ids=lambda page: page.name)
def test_files_to_touch_exist(page: Path) -> None:
    named = re.findall(
        r"`((?:robcal|pipeline|fixtures|tests|docs)/[\w/.]+\.(?:py|md))`", page.read_text(encoding="utf-8")
    )
    assert named
    assert not [name for name in named if not (ROOT / name).exists()]

"""`pipeline check` proposes ready robots where the campaign's own file is not the robot that was recorded."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from fixtures.campaigns import make_campaign
from pipeline.checking import measured
from pipeline.checking.check import check_campaign
from pipeline.checking.similar_robots import FOLDER


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("robots") / "campaign"
    make_campaign(folder, seed=6, level="frames", poses=20, verify=4, robot="irb120")
    return folder


@pytest.fixture
def campaign(source: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(source, tmp_path / "campaign"))


def warned(campaign: Path) -> list[str]:
    return [w for w in check_campaign(campaign).warnings if "misses" in w or "joints, as" in w]


def test_the_right_robot_needs_no_proposal(campaign: Path) -> None:
    assert not warned(campaign)


def test_another_robot_of_as_many_joints(campaign: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measured, "check_joint_log", lambda *_: [])  # the long search for slips of the pen
    text = (FOLDER / "kr150_class.yaml").read_text(encoding="utf-8")
    (campaign / "robot.yaml").write_text(text, encoding="utf-8")
    (sentence,) = warned(campaign)
    assert "misses the measurements by" in sentence
    assert "irb120_like.yaml by" in sentence


def test_no_robot_file(campaign: Path) -> None:
    (campaign / "robot.yaml").unlink()
    (sentence,) = warned(campaign)
    assert "has 6 joints, as irb120_like.yaml, kr150_class.yaml or ur10.yaml" in sentence


def test_a_robot_of_other_joints(campaign: Path) -> None:
    shutil.copy(FOLDER / "scara_600.yaml", campaign / "robot.yaml")
    (sentence,) = warned(campaign)
    assert "has 6 joints" in sentence

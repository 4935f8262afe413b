"""The files in configs/ are what the readers accept."""

from pathlib import Path

import pytest

from pipeline.campaign_schema import FORMAT, CampaignEntry
from robcal.files.body_file import check_ring_codes, read_body
from robcal.files.camera_file import read_camera
from robcal.files.robot_file import read_robot
from robcal.files.schemas import parse
from robcal.files.yaml_io import read_yaml

CONFIGS = Path(__file__).parents[2] / "configs"


def files(folder: str) -> list[Path]:
    return sorted((CONFIGS / folder).glob("*.yaml"))


@pytest.mark.parametrize("path", files("campaigns"), ids=lambda p: p.stem)
def test_campaigns(path: Path) -> None:
    entry = parse(read_yaml(path), CampaignEntry, FORMAT)
    named = [entry.robot.file if entry.robot else None, *(use.targets for use in entry.bodies.values())]
    if entry.station is not None:
        assert entry.station.body in entry.bodies
        named += [camera.calibration for camera in entry.station.cameras.values()]
    for name in named:
        assert name is None or (path.parent / name).is_file()


@pytest.mark.parametrize("path", files("bodies"), ids=lambda p: p.stem)
def test_bodies(path: Path) -> None:
    body = read_body(path)
    check_ring_codes(body)
    assert len(body.targets) >= 3


@pytest.mark.parametrize("path", files("cameras"), ids=lambda p: p.stem)
def test_cameras(path: Path) -> None:
    assert read_camera(path).camera.width > 0


@pytest.mark.parametrize("path", [*files("robots"), *files("hexapods")], ids=lambda p: p.stem)
def test_robots(path: Path) -> None:
    assert read_robot(path).n_joints >= 4

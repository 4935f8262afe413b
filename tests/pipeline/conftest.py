"""Small campaigns: at the level of points and frames, and one rendered in images."""

import csv
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from fixtures.bodies import target_plate
from fixtures.campaign_writer import RobotPlan, write_image_campaign
from fixtures.campaigns import make_campaign
from fixtures.image_campaign import full_campaign
from pipeline.runner import run_campaign

Rows = list[dict[str, str]]


def edit_rows(path: Path, change: Callable[[Rows], Rows | None]) -> None:
    """Change the rows of a CSV file in place."""
    with path.open(newline="", encoding="utf-8") as stream:
        rows: Rows = list(csv.DictReader(stream))
    rows = change(rows) or rows
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def edit_yaml(path: Path, change: Callable[[dict], None]) -> None:
    """Change the content of a YAML file in place."""
    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    change(data)
    path.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")


def _undiagnosed(folder: Path, seed: int, level: str) -> Path:
    make_campaign(folder, seed=seed, level=level, poses=40, verify=8)
    edit_yaml(folder / "campaign.yaml", lambda d: d.update(diagnosis={"enabled": False}))
    return folder


@pytest.fixture(scope="session")
def point_campaign_source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _undiagnosed(tmp_path_factory.mktemp("points") / "campaign", 5, "points")


@pytest.fixture
def point_campaign(point_campaign_source: Path, tmp_path: Path) -> Path:
    """A copy of a campaign of five targets a pose, measured as points."""
    return Path(shutil.copytree(point_campaign_source, tmp_path / "campaign"))


@pytest.fixture(scope="session")
def frame_campaign_source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _undiagnosed(tmp_path_factory.mktemp("frames") / "campaign", 6, "frames")


@pytest.fixture
def frame_campaign(frame_campaign_source: Path, tmp_path: Path) -> Path:
    """A copy of a campaign measured in 6D."""
    return Path(shutil.copytree(frame_campaign_source, tmp_path / "campaign"))


@pytest.fixture(scope="session")
def image_campaign_source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight survey images and two times fifteen station images of 640 x 512 pixels."""
    folder = tmp_path_factory.mktemp("images")
    plate = target_plate(size=0.42, coded=9, dots=6, diameter=0.02, relief=0.03, seed=1)
    plan = full_campaign(
        seed=1,
        survey_images=8,
        identify=12,
        verify=3,
        width=640,
        height=512,
        focal_mm=5.0,
        pixel_um=6.0,
        body=plate,
        robot=RobotPlan(identify=12, verify=3),
    )
    campaign = write_image_campaign(plan, folder / "campaign", folder / "truth", workers=1)
    edit_yaml(campaign / "campaign.yaml", lambda d: d.update(diagnosis={"enabled": False}))
    return campaign


@pytest.fixture
def image_campaign(image_campaign_source: Path, tmp_path: Path) -> Path:
    """A copy of the rendered campaign."""
    return Path(shutil.copytree(image_campaign_source, tmp_path / "campaign"))


@pytest.fixture(scope="session")
def image_run(image_campaign_source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The finished run of the rendered campaign. Never written to: copy what is needed."""
    folder = tmp_path_factory.mktemp("image_run") / "run"
    run_campaign(image_campaign_source, folder, until="verify", workers=1)
    return folder


@pytest.fixture
def detected(image_run: Path, tmp_path: Path) -> Path:
    """A run folder that already knows the targets of the rendered images (by their content), and nothing else."""
    folder = tmp_path / "run"
    shutil.copytree(image_run / "cache" / "detections", folder / "cache" / "detections")
    return folder

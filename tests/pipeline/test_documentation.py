"""What docs/campaigns.md shows is accepted by the readers."""

import re
from pathlib import Path

import pytest

from pipeline.campaign_schema import FORMAT, CampaignEntry
from robcal.files.body_file import check_ring_codes, read_body
from robcal.files.poses_table import read_poses
from robcal.files.robot_file import read_robot
from robcal.files.schemas import parse
from robcal.files.yaml_io import read_yaml

PAGE = Path(__file__).parents[2] / "docs" / "campaigns.md"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


@pytest.fixture
def written(tmp_path: Path) -> Path:
    """The files of the first example."""
    for block in reversed(blocks("yaml")):
        (tmp_path / block.splitlines()[0].removeprefix("# ")).write_text(block, encoding="utf-8")
    (tmp_path / "poses.csv").write_text(blocks("csv")[0], encoding="utf-8")
    return tmp_path


def test_files_of_the_example(written: Path) -> None:
    robot = read_robot(written / "robot.yaml")
    poses = read_poses(written / "poses.csv", robot, ["dumbbell"])
    assert poses.verify.sum() == 1
    body = read_body(written / "plate.yaml")
    check_ring_codes(body)
    assert body.targets[-1].normal == (0.0, 0.0, 1.0)


def test_campaigns_of_the_examples(tmp_path: Path) -> None:
    campaigns = [block for block in blocks("yaml") if block.startswith("# campaign.yaml")]
    assert len(campaigns) == 3
    for block in campaigns:
        path = tmp_path / "campaign.yaml"
        path.write_text(block, encoding="utf-8")
        entry = parse(read_yaml(path), CampaignEntry, FORMAT)
        assert entry.station is not None or entry.measurements[0].file in ("points.csv", "export.txt")

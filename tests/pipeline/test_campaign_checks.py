"""Contradictions of a campaign.yaml are told all at once, each with its line."""

from pathlib import Path

import yaml

from pipeline.campaign_reader import read_leniently


def test_all_contradictions_are_told_with_their_lines(point_campaign: Path) -> None:
    path = point_campaign / "campaign.yaml"
    content = yaml.safe_load(path.read_text())
    del content["poses"]
    content["body"] = "plat"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    campaign, faults = read_leniently(path)
    assert campaign is None
    wanted = ("measurements need the table of their poses", "a robot needs its joint angles", "there is no body 'plat'")
    assert all(sum(words in fault for fault in faults) == 1 for words in wanted)
    assert all(fault.startswith(f"{path}, line ") for fault in faults)

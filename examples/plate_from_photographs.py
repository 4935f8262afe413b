"""Coordinates of a plate's targets from photographs: detection, bundle adjustment with self-calibration, scale."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import robcal
from fixtures.campaign_writer import write_image_campaign
from fixtures.demo import HEIGHT, WIDTH, demo_plan


def main() -> robcal.SurveyResult:
    """Survey a plate that is rendered here; returns its network, with covariance."""
    plan = replace(demo_plan(), station=None, robot=None)
    with TemporaryDirectory() as place:
        folder = write_image_campaign(plan, Path(place) / "campaign", Path(place) / "truth")
        listed = robcal.read_body(next((folder / "bodies").glob("*.yaml")))
        codes = frozenset(t.id for t in listed.targets if t.id is not None)
        settings = robcal.DetectionSettings(known_codes=codes)
        photographs = sorted(p for p in folder.rglob("*") if p.suffix.lower() in {".png", ".jpg", ".tif", ".tiff"})
        images = [
            robcal.SurveyImage(p.name, robcal.detect_targets(robcal.read_image(p), settings)) for p in photographs
        ]
        bar = plan.surveys[0].bars[0]
        lengths = _bar(folder, bar)

    targets = [robcal.BodyTarget(t.id, t.code, t.diameter, t.xyz) for t in listed.targets]
    result = robcal.survey_body(images, targets, size=(WIDTH, HEIGHT), scale_bars=lengths)
    sigma = 1e3 * np.sqrt(np.mean(result.network.points_sigma**2))
    print(f"{len(result.network.ids)} targets in {len(images)} photographs, sure to {sigma:.4f} mm; {result.scale}")
    return result


def _bar(folder: Path, length: float) -> robcal.Lengths:
    """The scale bar as the campaign states it: two targets and the length between them."""
    from ruamel.yaml import YAML

    survey = next(iter(YAML(typ="safe").load(folder / "campaign.yaml")["bodies"].values()))["survey"]
    stated = survey["scale_bars"][0]
    return robcal.Lengths(np.array([stated["targets"]]), np.array([length]), np.array([5e-6]))


if __name__ == "__main__":
    main()

"""Coordinates of a plate's targets from photographs: detection, bundle adjustment with self-calibration, scale."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import yaml

import robcal
from fixtures.campaign_writer import write_image_campaign
from fixtures.demo import HEIGHT, WIDTH, demo_plan


def main() -> robcal.SurveyResult:
    """Survey a plate that is rendered here; returns its adjusted network."""
    with TemporaryDirectory() as place:
        plan = replace(demo_plan(), station=None, robot=None)
        folder = write_image_campaign(plan, Path(place) / "campaign", Path(place) / "truth")
        stated = yaml.safe_load((folder / "campaign.yaml").read_text())["bodies"]["plate"]["survey"]["scale_bars"][0]

        plate = robcal.read_body(folder / "plate.yaml").targets
        camera = robcal.read_camera(folder / "survey_plate_camera.yaml").camera
        images = [
            robcal.SurveyImage(path.name, robcal.detect_targets(robcal.read_image(path)))
            for path in sorted((folder / "survey" / "plate").glob("*.png"))
        ]
    bar = robcal.Lengths(
        ids=np.array([stated["targets"]]),
        length=np.array([stated["length_mm"]]) / 1e3,
        sigma=np.array([stated["sigma_mm"]]) / 1e3,
    )
    targets = [robcal.BodyTarget(t.id, t.code, t.diameter, t.xyz) for t in plate]
    result = robcal.survey_body(images, targets, size=(WIDTH, HEIGHT), camera=camera, scale_bars=bar)
    sigma = 1e3 * np.sqrt(np.mean(result.network.points_sigma**2))
    print(f"{len(result.network.ids)} targets in {len(images)} photographs, sure to {sigma:.4f} mm; {result.scale}")
    return result


if __name__ == "__main__":
    main()

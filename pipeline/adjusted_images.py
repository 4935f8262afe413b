"""The adjusted images of a run, as the recipe takes them."""

import re
from collections.abc import Mapping

import numpy as np

from pipeline import artifacts
from pipeline.bodies import surveyed_or_given
from pipeline.campaign import Campaign
from pipeline.runs import Run
from robcal.files.tables import read_table
from robcal.recipe.image_findings import ImageFindings, StationResult, SurveyImages, image_findings
from robcal.recipe.station import StationImages
from robcal.transforms import Array


def findings_of(campaign: Campaign, run: Run) -> ImageFindings:
    """Diagnose every set of images that the run has adjusted."""
    return image_findings(_surveys(campaign, run), _station(campaign, run))


def _surveys(campaign: Campaign, run: Run) -> list[SurveyImages]:
    found: list[SurveyImages] = []
    for name, source in campaign.bodies.items():
        result = run.find(artifacts.survey(name))
        if source.survey is None or result is None:
            continue
        start, path = source.survey.start, source.survey.start_path
        camera = path.stem if path is not None else f"survey_{name}"
        dots = any(target.code != "corner" for target in source.file.targets)
        found.append(SurveyImages(name, result.network, camera, start.camera if start else None, dots))
    return found


def _station(campaign: Campaign, run: Run) -> StationResult | None:
    orientation = run.find(artifacts.ORIENTATION)
    if orientation is None:
        return None
    images = StationImages(
        poses=campaign.poses.names if campaign.poses is not None else (),
        body=surveyed_or_given(campaign, run, orientation.body.name),
        marks=run.load(artifacts.MARKS),
        shapes=run.load(artifacts.SHAPES),
        start={name: s.start.camera if s.start else None for name, s in campaign.cameras.items()},
        covariates=image_covariates(campaign),
    )
    corrected = run.load(artifacts.CORRECTED_IMAGES)
    return StationResult(images, orientation, tuple(corrected))


def image_covariates(campaign: Campaign) -> Mapping[str, Array]:
    """Temperatures and hours of all poses (without a robot they are read here: its other columns do not count)."""
    if campaign.poses is None:
        return {}
    given = dict(campaign.poses.covariates)
    if campaign.robot is None:
        table = read_table(campaign.poses.path)
        wanted = [n for n in table.columns if n == "time_s" or re.fullmatch(r"temp_\w+_c", n)]
        given = {name: table.numbers(name) for name in wanted}
    found = {name: np.asarray(v, dtype=float) for name, v in given.items() if name.startswith("temp_")}
    if "time_s" in given:
        found["hours"] = np.asarray(given["time_s"], dtype=float) / 3600.0
    return found

"""What the images of surveys and of the station say about physics left out, from the artifacts of a run."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.bodies import surveyed_or_given
from pipeline.campaign import Campaign
from pipeline.runs import Run
from pipeline.tables import read_table
from robcal.diagnosis.images.diagnosis import ImageDiagnosis, ImageFinding, diagnose_images
from robcal.diagnosis.images.exchange import exchanged_targets
from robcal.diagnosis.images.lens_findings import beyond_lenses, station_findings, survey_findings
from robcal.diagnosis.images.scale_findings import scale_findings
from robcal.diagnosis.images.station import given_points, station_data
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.station.network import StationMarks, StationOrientation
from robcal.photogrammetry.station.seen_normals import Ellipses
from robcal.photogrammetry.survey.types import SurveyResult
from robcal.physics.images.data import survey_data
from robcal.transforms import Array

SHAPES = "shapes"
"""Artifact of the station: ellipses and light of its identified marks."""
TAKEN_BACK = "taken_back"
"""Artifact of the station: findings that it was oriented without (sizes of dots, centres that lag behind light)."""


@dataclass(frozen=True)
class ImageFindings:
    """Findings of all surveys and the station, the scans behind them, and the factor by which the marks scatter.

    `taken_back`: those of the findings that the station was oriented with, so that nothing of them is in its frames.
    """

    findings: tuple[ImageFinding, ...]
    scans: tuple[ImageDiagnosis, ...]
    noise: float
    taken_back: tuple[ImageFinding, ...] = ()


def images_of(campaign: Campaign, run: Run) -> ImageFindings:
    """Diagnose every set of images that the run has adjusted."""
    findings: list[ImageFinding] = []
    scans: list[ImageDiagnosis] = []
    noise = [1.0]
    taken_back: tuple[ImageFinding, ...] = ()
    cameras: dict[str, Camera] = {}
    if run.record("survey") is not None:
        for name, source in campaign.bodies.items():
            if source.survey is None or not run.has(f"survey_{name}"):
                continue
            result: SurveyResult = run.load(f"survey_{name}")
            start = source.survey.start
            path = source.survey.start_path
            camera = path.stem if path is not None else f"survey_{name}"
            findings += survey_findings(result.network, start.camera if start else None, camera)
            findings += scale_findings(result.network, name)
            dots = any(target.code != "corner" for target in source.file.targets)
            scans.append(diagnose_images(survey_data(result.network, None, camera, name, dots=dots)))
            noise.append(result.network.sigma0)
    if run.record("orient") is not None and run.has("orient"):
        orientation: StationOrientation = run.load("orient")
        names: Sequence[str] = campaign.poses.names if campaign.poses is not None else ()
        given = surveyed_or_given(campaign, run, orientation.body.name)
        files = {camera: s.start.camera if s.start else None for camera, s in campaign.cameras.items()}
        marks: dict[str, StationMarks] = run.load("marks")
        shapes: dict[str, Ellipses] = run.load(SHAPES) if run.has(SHAPES) else {}
        data = station_data(orientation, tuple(names), given, files, image_covariates(campaign))
        data = replace(data, light=light_of(orientation, marks, shapes))
        swapped = exchanged_targets(orientation, marks, given)
        explained = frozenset(str(name) for f in swapped for name in (f.where, f.parameters["with"]))
        stated = given_points(orientation, given)
        taken_back = tuple(run.load(TAKEN_BACK)) if run.has(TAKEN_BACK) else ()
        findings += [*taken_back, *swapped]
        findings += station_findings(orientation, tuple(names), stated, data.inflation, explained)
        scans.append(diagnose_images(data))
        noise.append(orientation.sigma0)
        cameras |= dict(zip(orientation.names, orientation.cameras, strict=True))
    for scan in scans:
        findings += scan.findings
    return ImageFindings(beyond_lenses(findings, cameras), tuple(scans), max(noise), taken_back)


def light_of(
    orientation: StationOrientation, marks: Mapping[str, StationMarks], shapes: Mapping[str, Ellipses]
) -> Array | None:
    """Light (m,) of the marks that a station was adjusted with; None where no images were read."""
    if not shapes:
        return None
    known = {
        (name, int(pose), int(target)): float(light)
        for name, shape in shapes.items()
        for pose, target, light in zip(marks[name].pose, marks[name].target, shape.light, strict=True)
    }
    m = orientation.marks
    keys = zip(m.camera, orientation.poses[m.pose], orientation.body.ids[m.target], strict=True)
    return np.array([known.get((orientation.names[c], int(p), int(t)), np.nan) for c, p, t in keys])


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

"""What the images of surveys and of the station say about physics left out, from the artifacts of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.campaign import Campaign
from pipeline.runs import Run
from robcal.diagnosis.image_data import station_data, survey_data
from robcal.diagnosis.image_diagnosis import ImageDiagnosis, ImageFinding, diagnose_images
from robcal.diagnosis.lens_findings import station_findings, survey_findings
from robcal.photogrammetry.station_network import StationOrientation
from robcal.photogrammetry.survey_types import SurveyResult


@dataclass(frozen=True)
class ImageFindings:
    """Findings of all surveys and the station, the scans behind them, and the factor by which the marks scatter."""

    findings: tuple[ImageFinding, ...]
    scans: tuple[ImageDiagnosis, ...]
    noise: float


def images_of(campaign: Campaign, run: Run) -> ImageFindings:
    """Diagnose every set of images that the run has adjusted."""
    findings: list[ImageFinding] = []
    scans: list[ImageDiagnosis] = []
    noise = [1.0]
    if run.record("survey") is not None:
        for name, source in campaign.bodies.items():
            if source.survey is None or not run.has(f"survey_{name}"):
                continue
            result: SurveyResult = run.load(f"survey_{name}")
            start = source.survey.start
            path = source.survey.start_path
            camera = path.stem if path is not None else f"survey_{name}"
            findings += survey_findings(result.network, start.camera if start else None, camera)
            scans.append(diagnose_images(survey_data(result.network, None, camera)))
            noise.append(result.network.sigma0)
    if run.record("orient") is not None and run.has("orient"):
        orientation: StationOrientation = run.load("orient")
        names: Sequence[str] = campaign.poses.names if campaign.poses is not None else ()
        findings += station_findings(orientation, tuple(names))
        scans.append(diagnose_images(station_data(orientation, tuple(names))))
        noise.append(orientation.sigma0)
    for scan in scans:
        findings += scan.findings
    return ImageFindings(tuple(findings), tuple(scans), max(noise))

"""What the images of surveys and of the station say about physics left out."""

from collections.abc import Sequence
from dataclasses import dataclass

from robcal.diagnosis.images.diagnosis import ImageDiagnosis, ImageFinding, diagnose_images
from robcal.diagnosis.images.exchange import exchanged_targets
from robcal.diagnosis.images.lens_findings import beyond_lenses, scale_findings, station_findings, survey_findings
from robcal.diagnosis.images.station import given_points
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.network import CameraNetwork
from robcal.photogrammetry.station.network import StationOrientation
from robcal.physics.images.data import survey_data
from robcal.recipe.station import StationImages


@dataclass(frozen=True)
class ImageFindings:
    """Findings of all surveys and the station, the scans behind them, and the factor by which the marks scatter.

    `corrected`: those of the findings that the station was oriented with, so that nothing of them is in its frames.
    """

    findings: tuple[ImageFinding, ...]
    scans: tuple[ImageDiagnosis, ...]
    noise: float
    corrected: tuple[ImageFinding, ...] = ()


@dataclass(frozen=True)
class SurveyImages:
    """A finished survey: its camera's name and file, and whether the targets are dots (else corners of a board)."""

    name: str
    network: CameraNetwork
    camera: str
    start: Camera | None
    dots: bool = True


@dataclass(frozen=True)
class StationResult:
    """An oriented station, what its cameras saw, and findings that it was oriented without."""

    images: StationImages
    orientation: StationOrientation
    corrected: tuple[ImageFinding, ...] = ()


def image_findings(surveys: Sequence[SurveyImages], station: StationResult | None) -> ImageFindings:
    """Diagnose every set of images that was adjusted."""
    findings: list[ImageFinding] = []
    scans: list[ImageDiagnosis] = []
    noise = [1.0]
    cameras: dict[str, Camera] = {}
    for survey in surveys:
        findings += survey_findings(survey.network, survey.start, survey.camera)
        findings += scale_findings(survey.network, survey.name)
        scans.append(diagnose_images(survey_data(survey.network, None, survey.camera, survey.name, dots=survey.dots)))
        noise.append(survey.network.sigma0)
    if station is not None:
        images, orientation = station.images, station.orientation
        data = images.data(orientation, images.body)
        swapped = exchanged_targets(orientation, images.marks, images.body)
        explained = frozenset(str(name) for f in swapped for name in (f.where, f.parameters["with"]))
        stated = given_points(orientation, images.body)
        findings += [*station.corrected, *swapped]
        findings += station_findings(orientation, images.poses, stated, data.inflation, explained)
        scans.append(diagnose_images(data))
        noise.append(orientation.sigma0)
        cameras |= dict(zip(orientation.names, orientation.cameras, strict=True))
    for scan in scans:
        findings += scan.findings
    corrected = () if station is None else station.corrected
    return ImageFindings(beyond_lenses(findings, cameras), tuple(scans), max(noise), corrected)

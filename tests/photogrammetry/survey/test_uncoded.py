"""A body without any code, nominal coordinates given: identified from the arrangement of its dots."""

from dataclasses import dataclass, replace

import numpy as np

from robcal.imaging.detections import TargetKind
from robcal.photogrammetry.survey.survey import BodyTarget, SurveyImage, needs_geometry, survey_body
from tests.photogrammetry.networks import aligned_error, detections, make_network


@dataclass(frozen=True)
class Found:
    """The columns of detections that matter here."""

    xy: np.ndarray
    covariance: np.ndarray
    semi_axes: np.ndarray
    contrast: np.ndarray
    code: np.ndarray
    kind: np.ndarray
    angle: np.ndarray
    message: str = ""


def test_a_plate_of_plain_dots() -> None:
    rng = np.random.default_rng(0)
    truth = make_network(rng, images=12, targets=12, focal_factor=1.4)
    nominal = truth.points + rng.normal(0, 2e-4, truth.points.shape)
    targets = [BodyTarget(i + 1, None, 0.008, tuple(map(float, p))) for i, p in enumerate(nominal)]
    images = []
    for image in detections(truth, 0, rng):
        d = image.detections
        assert d is not None
        kind = np.full(len(d.xy), TargetKind.DOT, dtype=np.int8)
        found = Found(d.xy, d.covariance, d.semi_axes, np.ones(len(d.xy)), d.code, kind, d.angle)
        images.append(SurveyImage(image.name, found))  # type: ignore[arg-type]
    assert needs_geometry(images, targets)
    net = survey_body(images, targets, size=(2400, 1800)).network
    assert len(net.image_names) >= 9
    order = net.index_of(range(1, 13))
    e = aligned_error(net.points[order], truth.points, scale=True)
    assert np.sqrt(np.mean(e**2)) < 3e-5
    assert not needs_geometry(images, [replace(t, xyz=None) for t in targets])

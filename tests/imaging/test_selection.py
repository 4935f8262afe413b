"""From candidates to dots: what is found, what is refused and under which reason, what statistics the dots give."""

import numpy as np
import pytest
from numpy.typing import NDArray

from robcal.imaging.blobs import Candidates
from robcal.imaging.detections import Reason, RejectionLog
from robcal.imaging.dot_fitting import FittedDots, blur_without_pixel, fit_dots
from robcal.imaging.noise import NoiseModel, estimate_noise
from robcal.imaging.segmentation import coarse_background, find_candidates
from robcal.imaging.selection import accept, may_be_ring_parts
from robcal.imaging.settings import DetectionSettings
from tests.imaging.rendering import Dot, expose, render

DOTS = [Dot(40.3, 40.6, 9, 8, 0.4), Dot(120.2, 45.1, 6, 4, 1.0), Dot(80.7, 110.4, 12, 12)]
SETTINGS = DetectionSettings()


def _image(dots: list[Dot], seed: int = 1) -> NDArray:
    return expose(render(170, 150, dots), np.random.default_rng(seed))


def _fitted(image: NDArray) -> tuple[FittedDots, Candidates, NoiseModel, RejectionLog]:
    noise, log = estimate_noise(image), RejectionLog()
    candidates = find_candidates(image, noise, SETTINGS, log)
    dots, fitted_noise, _ = fit_dots(image, candidates, noise, np.inf, SETTINGS.max_misfit)
    return dots, candidates, fitted_noise, log


def test_every_blob_is_a_candidate_near_its_centre() -> None:
    _, candidates, _, _ = _fitted(_image(DOTS))
    for dot in DOTS:
        distance = np.linalg.norm(candidates.xy - [dot.x, dot.y], axis=1)
        assert distance.min() < 0.5
        assert candidates.semi_axes[distance.argmin(), 0] == pytest.approx(dot.a, rel=0.15)


def test_background_does_not_follow_the_dots() -> None:
    image = _image(DOTS)
    background = coarse_background(image, SETTINGS.max_axis_px)
    assert background.shape == image.shape
    assert background.max() < 40  # dots reach 195


def test_fits_are_where_the_dots_are_within_their_covariance() -> None:
    dots, _, noise, log = _fitted(_image(DOTS))
    kept = accept(dots, _image(DOTS), noise, SETTINGS, log)
    assert len(kept) == 3
    for dot in DOTS:
        row = int(np.argmin(np.linalg.norm(kept.xy - [dot.x, dot.y], axis=1)))
        e = kept.xy[row] - [dot.x, dot.y]
        assert e @ np.linalg.solve(kept.covariance[row], e) < 16.0
        np.testing.assert_allclose(kept.semi_axes[row], [dot.a, dot.b], atol=0.1)


@pytest.mark.parametrize(
    ("dot", "reason"), [(Dot(80.0, 75.0, 30, 5, 0.7), Reason.ELONGATED), (Dot(80.0, 4.0, 9, 9), Reason.BORDER)]
)
def test_what_is_no_dot_is_refused_with_its_reason(dot: Dot, reason: Reason) -> None:
    image = _image([dot])
    dots, _, noise, log = _fitted(image)
    assert len(accept(dots, image, noise, SETTINGS, log)) == 0
    assert log.result().counts.get(reason, 0) >= 1


def test_segments_of_a_ring_wait_for_their_dot() -> None:
    _, candidates, _, _ = _fitted(_image([Dot(85.0, 75.0, 14, 14, bits=0b101001000011)]))
    late = may_be_ring_parts(candidates)
    host = int(np.argmin(np.linalg.norm(candidates.xy - [85.0, 75.0], axis=1)))
    assert not late[host]
    assert np.delete(late, host).all()
    assert late.sum() >= 2


def test_noise_grows_with_brightness_as_rendered() -> None:
    rng = np.random.default_rng(3)
    dots = [Dot(40 + 60 * i, 40 + 60 * j, 18, 18) for i in range(5) for j in range(4)]
    image = expose(render(320, 270, dots), rng, read_noise=1.0, gain=0.08)
    noise, log = estimate_noise(image), RejectionLog()
    candidates = find_candidates(image, noise, SETTINGS, log)
    _, fitted, _ = fit_dots(image, candidates, noise, np.inf, SETTINGS.max_misfit)
    assert fitted.at(np.array(15.0)) == pytest.approx(1.0 + 0.08 * 15, rel=0.25)
    assert fitted.at(np.array(195.0)) == pytest.approx(1.0 + 0.08 * 195, rel=0.25)


def test_blur_of_the_lens_is_without_the_pixel() -> None:
    np.testing.assert_allclose(
        blur_without_pixel(np.sqrt(np.array([0.49 + 1 / 12, 1 / 12, 0.0]))), [0.7, 0, 0], atol=1e-9
    )

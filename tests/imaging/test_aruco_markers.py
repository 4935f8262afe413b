"""Markers: diagonals, derivatives, and centres of rendered markers."""

import cv2
import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.imaging.aruco_markers import diagonal_intersection, dictionary_by_name
from robcal.imaging.detect import detect_targets
from robcal.imaging.detections import TargetKind
from robcal.imaging.settings import DetectionSettings

QUAD = np.array([[[10.0, 12.0], [52.0, 9.0], [60.0, 50.0], [8.0, 44.0]]])


def test_diagonals_meet_where_both_lines_are() -> None:
    centre, _ = diagonal_intersection(QUAD)
    for first, second in ((0, 2), (1, 3)):
        along = QUAD[0, second] - QUAD[0, first]
        across = centre[0] - QUAD[0, first]
        assert abs(along[0] * across[1] - along[1] * across[0]) < 1e-9


def test_derivative_agrees_with_differences() -> None:
    _, derivative = diagonal_intersection(QUAD)
    for corner in range(4):
        for axis in range(2):
            step = np.zeros_like(QUAD)
            step[0, corner, axis] = 1e-6
            difference = (diagonal_intersection(QUAD + step)[0] - diagonal_intersection(QUAD - step)[0]) / 2e-6
            np.testing.assert_allclose(derivative[0, :, corner, axis], difference[0], atol=1e-7)


@pytest.mark.parametrize("bits", [8, 16])
def test_marker_centres_and_ids(bits: int) -> None:
    rng = np.random.default_rng(1)
    dictionary = dictionary_by_name("4X4_50")
    sub = 8
    errors = []
    for number in range(12):
        flat = np.full((640, 640), 255, np.uint8)
        flat[120:520, 120:520] = cv2.aruco.generateImageMarker(dictionary, number, 400)
        corners = np.array([[30, 30], [170, 30], [170, 170], [30, 170]], float) + rng.uniform(-15, 15, (4, 2))
        homography = cv2.getPerspectiveTransform(
            np.array([[-0.5, -0.5], [639.5, -0.5], [639.5, 639.5], [-0.5, 639.5]], np.float32),
            (((corners + 0.5) * sub) - 0.5).astype(np.float32),
        )
        large = cv2.warpPerspective(flat, homography, (200 * sub, 200 * sub), flags=cv2.INTER_AREA, borderValue=255)
        light = cv2.GaussianBlur(large.astype(float), (0, 0), 0.6 * sub).reshape(200, sub, 200, sub).mean(axis=(1, 3))
        grey = 20 + 0.7 * light + rng.normal(0, 1, light.shape)
        image = grey.astype(np.uint8) if bits == 8 else (grey * 200).astype(np.uint16)
        found = detect_targets(image, DetectionSettings(ring12=False, polarity="dark", aruco="4X4_50", max_axis_px=5.0))
        markers = found.kind == TargetKind.ARUCO
        assert list(found.code[markers]) == [number]
        middle = cv2.perspectiveTransform(np.array([[[319.5, 319.5]]], np.float32), homography)[0, 0]
        errors.append(found.xy[markers][0] - ((middle + 0.5) / sub - 0.5))
        assert np.linalg.eigvalsh(found.covariance[markers][0])[0] > 0
    assert np.sqrt(np.mean(np.square(errors))) < 0.1


def test_unknown_dictionary_is_named_with_the_choice() -> None:
    with pytest.raises(InvalidInput, match="4X4_50"):
        dictionary_by_name("nonsense")

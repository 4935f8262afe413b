"""A lens that is no polynomial: told by its residuals, taken up by splines; a perfect one is left alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.files.camera_export import EXPORTS
from robcal.files.camera_file import CameraFile, read_camera, write_camera
from robcal.photogrammetry.core.camera import Camera, normalise, project, project_with_jacobians
from robcal.photogrammetry.core.network import Lengths
from robcal.photogrammetry.core.splined import SplinedCamera
from robcal.photogrammetry.survey.lens_field import lens_field
from robcal.photogrammetry.survey.splined_lens import with_splined_lens
from robcal.photogrammetry.survey.survey import BodyTarget, SurveyResult, survey_body
from robcal.transforms import Array
from tests.photogrammetry.networks import aligned_error, detections, make_network

SIZE = (2400, 1800)
NODES = 2.0 * np.random.default_rng(8).standard_normal((6, 8, 2))
SPLINED = SplinedCamera(*SIZE, 3000.0, 3002.0, 1205.0, 890.0, -0.1, 0.05, 2e-4, -1e-4, 0.01, nodes=NODES)


def test_derivatives_and_inverse() -> None:
    p = np.random.default_rng(1).uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 1.4], (40, 3))
    xy, d_point, d_in = project_with_jacobians(SPLINED, p)
    np.testing.assert_allclose(xy, project(SPLINED, p))
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        change = (project(SPLINED, p + step) - project(SPLINED, p - step)) / 2e-6
        np.testing.assert_allclose(d_point[..., k], change, rtol=1e-5, atol=1e-2)
    for k in range(9):
        step = 1e-5 * np.eye(9)[k]
        ends = [project(SPLINED.with_vector(SPLINED.vector + s), p) for s in (step, -step)]
        np.testing.assert_allclose(d_in[..., k], (ends[0] - ends[1]) / 2e-5, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(normalise(SPLINED, xy), p[:, :2] / p[:, 2:], atol=1e-10)


def test_a_constant_field_is_a_shift_and_the_edge_goes_on_beyond_the_image() -> None:
    even = replace(SPLINED, nodes=np.tile([0.3, -0.2], (5, 5, 1)))
    p = np.array([[0.1, 0.1, 1.0], [2.0, -1.5, 1.0]])
    np.testing.assert_allclose(project(even, p) - project(even.brown, p), np.tile([0.3, -0.2], (2, 1)), atol=1e-10)


def ripple(xy: Array, size_px: float) -> Array:
    """A smooth field that no polynomial of Brown's has (a wavy filter glass)."""
    x, y = xy[:, 0] / SIZE[0], xy[:, 1] / SIZE[1]
    return size_px * np.stack([np.sin(9.0 * x) * np.cos(7.0 * y), np.cos(8.0 * x + 1.0) * np.sin(6.0 * y)], axis=1)


def surveyed(seed: int, size_px: float) -> tuple[SurveyResult, object, Array]:
    rng = np.random.default_rng(seed)
    truth = make_network(rng, images=16, targets=49)
    m = truth.marks
    truth = replace(truth, marks=replace(m, xy=m.xy + ripple(m.xy, size_px)))
    images = detections(truth, 49, rng)
    targets = [BodyTarget(100 + i, "ring12", None, None) for i in range(49)]
    bar = Lengths([[100, 148]], [float(np.linalg.norm(truth.points[0] - truth.points[48]))], [3e-6])

    def survey(camera: Camera | None) -> SurveyResult:
        return survey_body(images, targets, size=SIZE, camera=camera, scale_bars=bar)

    done = survey(None)
    return done, with_splined_lens(done, survey), truth.points


def test_a_lens_that_is_no_polynomial_gets_splines() -> None:
    done, splined, points = surveyed(3, 0.3)
    assert splined is not None
    before, after = done.network, splined.result.network
    assert splined.field.p_value < 1e-6
    assert isinstance(after.camera, SplinedCamera)
    assert after.sigma0_px < 0.065 < 0.1 < before.sigma0_px

    def missed(net: object) -> float:
        rows = np.argsort(net.ids)
        return float(np.sqrt(np.mean(aligned_error(net.points[rows], points, scale=True) ** 2)))

    assert missed(after) < 0.5 * missed(before)


def test_brown_s_own_lens_is_left_alone() -> None:
    done, splined, _ = surveyed(0, 0.0)
    field = lens_field(done.network)
    assert field is not None
    assert not field.significant
    assert splined is None


def test_files_keep_the_splines_and_other_programs_are_refused(tmp_path: Path) -> None:
    write_camera(tmp_path / "c.yaml", CameraFile(SPLINED))
    back = read_camera(tmp_path / "c.yaml").camera
    assert isinstance(back, SplinedCamera)
    assert back == SPLINED
    np.testing.assert_allclose(back.nodes, SPLINED.nodes, rtol=1e-12)
    for _, write in EXPORTS.values():
        with pytest.raises(InvalidInput, match="no other program has a splined lens"):
            write(SPLINED, "eye")


HEAD = "format: robcal/camera-1\nwidth: 1280\nheight: 960\nfx: 900\nfy: 900\ncx: 640\ncy: 480\n"
TABLE = "[[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD + "model: splined\n", "belong together"),
        (HEAD + f"spline: {{dx_px: {TABLE}, dy_px: {TABLE}}}\n", "belong together"),
        (HEAD + f"model: splined\nspline: {{dx_px: {TABLE}, dy_px: [[0, 0]]}}\n", "as many rows and columns"),
        (HEAD + f"model: splined\nk4: 0.1\nspline: {{dx_px: {TABLE}, dy_px: {TABLE}}}\n", "no k4"),
    ],
)
def test_splines_that_cannot_be_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(InvalidInput, match=message):
        read_camera(tmp_path / "c.yaml")

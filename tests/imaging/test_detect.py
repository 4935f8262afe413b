"""Detection against rendered truth: precision, honesty of the covariance, shading, polarity, saturation, bad images."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fixtures.own_images import image_plan, own_plate
from fixtures.own_station import draw_own
from fixtures.render import render_image
from fixtures.scene import Lighting, Scene
from robcal.errors import InvalidInput
from robcal.imaging.cramer_rao import centre_bound
from robcal.imaging.detect import detect_targets, saturation_level
from robcal.imaging.detections import Detections, Reason
from robcal.imaging.noise import NoiseModel
from robcal.imaging.ring_code import canonical_id, is_id
from robcal.imaging.settings import DetectionSettings
from tests.imaging.rendering import Dot, expose, render, scene

BLUR = 0.7


def field(rng: np.random.Generator, a: float, ratio: float, side: int = 9) -> tuple[list[Dot], int]:
    """Dots on a grid with random sub-pixel place and turn, and the image's side."""
    pitch = int(3 * a + 14)
    dots = [
        Dot(
            pitch * (i + 0.7) + rng.uniform(-0.5, 0.5),
            pitch * (j + 0.7) + rng.uniform(-0.5, 0.5),
            a,
            a * ratio,
            rng.uniform(0, np.pi),
        )
        for i in range(side)
        for j in range(side)
    ]
    return dots, pitch * (side + 1)


def errors(found: Detections, dots: list[Dot]) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, 2) of all dots, each found once, and the rows of the detections."""
    true = np.array([[d.x, d.y] for d in dots])
    distance, row = cKDTree(found.xy).query(true)
    assert distance.max() < 1.0
    assert len(set(row)) == len(dots)
    return found.xy[row] - true, row


@pytest.mark.parametrize(("a", "ratio"), [(2.0, 1.0), (4.0, 0.6), (6.0, 1.0), (10.0, 0.5)])
def test_centres_reach_the_bound_and_covariance_is_honest(a: float, ratio: float) -> None:
    rng = np.random.default_rng(int(10 * a))
    dots, side = field(rng, a, ratio)
    found = detect_targets(expose(render(side, side, dots, BLUR), rng))
    error, row = errors(found, dots)
    noise = NoiseModel(1.0 + 1 / 12 + 0.05 * 15, 0.05, 15.0)
    bound = centre_bound((a, a * ratio), 0.0, BLUR, 180.0, 15.0, noise)
    assert (error**2).mean() < 1.5**2 * np.trace(bound) / 2
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance[row]), error)
    assert 0.6 < squared.mean() / 2 < 1.4
    np.testing.assert_allclose(np.median(found.semi_axes[row], axis=0), [a, a * ratio], rtol=0.12)


@pytest.mark.parametrize("size", [1.0, 1.4])
def test_tiny_dots_are_found_with_larger_covariance(size: float) -> None:
    rng = np.random.default_rng(8)
    dots, side = field(rng, size, 0.9)
    found = detect_targets(expose(render(side, side, dots, BLUR), rng))
    true = np.array([[d.x, d.y] for d in dots])
    distance, row = cKDTree(found.xy).query(true)
    assert (distance < 0.3).mean() > 0.97
    error = (found.xy[row] - true)[distance < 0.3]
    assert np.sqrt((error**2).mean()) < 0.03
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance[row[distance < 0.3]]), error)
    assert 0.4 < squared.mean() / 2 < 1.7


def test_bias_under_shading_is_below_a_hundredth() -> None:
    rng = np.random.default_rng(9)
    a = 8.0
    dots, side = field(rng, a, 1.0, side=8)
    # ten percent over the dot's diameter
    light = render(side, side, dots, BLUR, gradient=(0.1 / (2 * a), 0.0))
    found = detect_targets(expose(light, rng, contrast=150.0))
    error, row = errors(found, dots)
    assert np.abs(error.mean(axis=0)).max() < 0.01
    assert np.median(found.gain_gradient[row, 0]) == pytest.approx(0.1 / (2 * a), rel=0.25)


@pytest.mark.parametrize("blur", [0.7, 1.0])
@pytest.mark.parametrize("radius", [2.5, 4.0, 6.0])
@pytest.mark.parametrize("known", [True, False])
def test_ring_around_does_not_pull_the_centre(radius: float, blur: float, known: bool) -> None:
    rng = np.random.default_rng(3)
    bits = 0b111110000000  # all light on one side
    phases, pitch = rng.uniform(0, 2 * np.pi, 25), int(7 * radius + 14)
    places = (np.indices((5, 5)).reshape(2, -1).T + 0.5) * pitch + rng.uniform(-0.5, 0.5, (25, 2))
    dots = [Dot(*place, radius, radius, 0.0, bits, phase) for place, phase in zip(places, phases, strict=True)]
    image = expose(render(5 * pitch, 5 * pitch, dots, blur), rng, read_noise=0.5, gain=0.01)
    codes = frozenset({canonical_id(bits) if known else 0b101010101011})
    found = detect_targets(image, DetectionSettings(known_codes=codes))
    distance, row = cKDTree(found.xy).query(places)
    assert distance.max() < 0.2
    assert (found.code[row] >= 0).all() == known
    middle = phases + 2.5 * np.pi / 6
    towards = np.stack([np.cos(middle), np.sin(middle)], axis=-1)
    assert abs(((found.xy[row] - places) * towards).sum(axis=1).mean()) < 0.01


@pytest.mark.parametrize("bits", [8, 16])
def test_full_scene(bits: int) -> None:
    rng = np.random.default_rng(10)
    ids = [k for k in range(1, 4095) if is_id(k) and 4 <= k.bit_count() <= 8]
    dots = scene(rng, 900, 700, 40, (4.5, 9.0), [int(k) for k in rng.choice(ids, 15, replace=False)], 3.4)
    light = render(900, 700, dots, BLUR)
    scale = 1.0 if bits == 8 else 250.0
    image = expose(
        light, rng, contrast=180 * scale, background=15 * scale, read_noise=scale, gain=0.05 * scale, bits=bits
    )
    found = detect_targets(image)
    error, row = errors(found, dots)
    assert len(found) == len(dots)
    assert np.sqrt((error**2).mean()) < 0.02
    assert [int(found.code[row[k]]) for k in range(len(dots))] == [-1 if d.bits is None else d.bits for d in dots]


def test_dark_dots() -> None:
    rng = np.random.default_rng(11)
    dots, side = field(rng, 6.0, 0.7, side=5)
    bright = expose(render(side, side, dots, BLUR), rng)
    found = detect_targets(255 - bright, DetectionSettings(polarity="dark"))
    error, row = errors(found, dots)
    assert np.sqrt((error**2).mean()) < 0.02
    assert (found.contrast < 0).all()
    assert np.median(found.background[row]) == pytest.approx(240.0, abs=2.0)
    assert len(detect_targets(bright, DetectionSettings(polarity="dark"))) == 0


def test_saturated_dots_are_flagged_and_stay_accurate() -> None:
    rng = np.random.default_rng(12)
    dots, side = field(rng, 6.0, 0.8, side=7)
    found = detect_targets(expose(render(side, side, dots, BLUR), rng, contrast=420.0, background=20.0))
    error, row = errors(found, dots)
    assert found.saturated[row].all()
    assert np.sqrt((error**2).mean()) < 0.02
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance[row]), error)
    assert 0.4 < squared.mean() / 2 < 1.7


def test_plateau_below_the_range_is_saturation() -> None:
    rng = np.random.default_rng(13)
    image = np.minimum(rng.normal(3500, 400, (300, 300)), 4095).astype(np.uint16)
    assert saturation_level(image) == 4095
    assert saturation_level(rng.normal(3000, 100, (300, 300)).astype(np.uint16)) == float("inf")


def test_what_is_no_dot_is_refused_with_a_reason() -> None:
    rng = np.random.default_rng(14)
    light = render(400, 300, [Dot(80, 80, 8, 7)], BLUR)
    light[150:154, 50:100] += 0.8  # an edge
    light[200:220, 100:140] += 0.7  # a plate
    light[240:252, 300:303] += 0.9  # a cross
    light[245:248, 296:308] += 0.9
    yy, xx = np.indices(light.shape)
    light += 0.9 * (np.hypot(xx - 330, yy - 100) < 60)  # a lamp
    light += 0.9 * (np.hypot(xx - 398, yy - 250) < 9)  # cut by the border
    found = detect_targets(expose(light, rng), DetectionSettings(max_axis_px=30.0))
    assert len(found) == 1
    assert np.hypot(*(found.xy[0] - (80, 80))) < 0.05
    counts = found.rejected.counts
    for reason in (Reason.BORDER, Reason.TOO_LARGE, Reason.SHAPE, Reason.ELONGATED):
        assert counts.get(reason, 0) > 0
    assert len(found.rejected.xy) == len(found.rejected.reason)


def test_glare_of_a_lamp_hides_no_dot() -> None:
    rng = np.random.default_rng(15)
    dots = [Dot(100, 90, 7, 6), Dot(130, 150, 7, 6), Dot(70, 160, 5, 5)]
    yy, xx = np.indices((240, 240))
    glare = 0.4 * np.exp(-((xx - 120) ** 2 + (yy - 120) ** 2) / (2 * 45**2))
    light = render(240, 240, dots, BLUR) * 0.5 + glare
    error, _ = errors(detect_targets(expose(light, rng)), dots)
    assert np.abs(error).max() < 0.06


@pytest.mark.parametrize(
    ("image", "told"),
    [
        (np.zeros((200, 300), np.uint8), "black"),
        (np.full((200, 300), 255, np.uint8), "saturated"),
        (np.full((200, 300), 120, np.uint8), "evenly grey"),
        (np.full((200, 300), 65535, np.uint16), "saturated"),
    ],
)
def test_images_of_nothing(image: np.ndarray, told: str) -> None:
    found = detect_targets(image)
    assert len(found) == 0
    assert told in found.message


def test_photograph_of_something_else_has_no_code_and_ends() -> None:
    rng = np.random.default_rng(16)
    field_ = sum(np.kron(rng.normal(size=(600 // s, 800 // s)), np.ones((s, s))) * s for s in (2, 5, 20, 100))
    image = np.clip(128 + 1.2 * field_ + rng.normal(0, 5, (600, 800)), 0, 255).astype(np.uint8)
    found = detect_targets(image)
    assert (found.code < 0).all()
    noise = rng.integers(0, 256, (600, 800)).astype(np.uint8)
    assert len(detect_targets(noise)) < 20


@pytest.mark.parametrize(
    "image",
    [np.zeros((20, 20, 3), np.uint8), np.zeros((20, 20)), np.zeros((4, 20), np.uint8), np.zeros((20, 20), np.int32)],
)
def test_refuses_what_is_no_grey_image(image: np.ndarray) -> None:
    with pytest.raises(InvalidInput):
        detect_targets(image)


def test_image_is_not_changed_and_result_is_read_only() -> None:
    rng = np.random.default_rng(17)
    dots, side = field(rng, 5.0, 1.0, side=3)
    image = expose(render(side, side, dots, BLUR), rng)
    before = image.copy()
    found = detect_targets(image)
    assert (image == before).all()
    with pytest.raises(ValueError, match="read-only"):
        found.xy[0, 0] = 0.0


def test_hot_pixels_do_not_pull_centres() -> None:
    rng = np.random.default_rng(18)
    dots, side = field(rng, 7.0, 1.0, side=6)
    image = expose(render(side, side, dots, BLUR), rng)
    for dot in dots:
        image[int(dot.y + 2), int(dot.x + 11)] = 255  # in the background of each
        image[int(dot.y), int(dot.x + 3)] = 20  # dead, inside each
    error, _ = errors(detect_targets(image), dots)
    assert np.abs(error.mean(axis=0)).max() < 0.01
    assert np.sqrt((error**2).mean()) < 0.02


@pytest.mark.parametrize(
    "wrong",
    [{"polarity": "grey"}, {"min_axis_px": -1.0}, {"min_axis_px": 5.0, "max_axis_px": 2.0}, {"max_candidates": 0}],
)
def test_settings_are_checked(wrong: dict) -> None:
    with pytest.raises(InvalidInput):
        DetectionSettings(**wrong)


def test_dark_codes_on_a_small_bright_plate_before_a_dark_room() -> None:
    # dots are as dark as what is beside the plate
    truth = draw_own(image_plan(7103, robot="irb120"))
    pose = truth.robot.recorded.ids.index("p025")
    body, camera = own_plate(7103, "irb120"), truth.cameras["left"]
    world_T_body = truth.robot.true_frames[pose]
    scene_ = Scene(((body, world_T_body),), Lighting(0.7, 0.45), texture_seed=7110)
    image = render_image(scene_, camera, truth.base_T_camera["left"]).image
    codes = frozenset(int(i) for i in body.ids)
    found = detect_targets(image, DetectionSettings(polarity="dark", known_codes=codes))
    assert codes <= set(found.code.tolist())

"""Surveys from detections: identity of uncoded dots, frame, scale, names, bad images; both engines."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from robcal.errors import DegenerateGeometry, InvalidInput, NotIdentifiable
from robcal.photogrammetry.bundle.body_frame import fit_similarity
from robcal.photogrammetry.bundle.settings import AdjustSettings
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.network import CameraNetwork, Lengths
from robcal.photogrammetry.survey.survey import BodyTarget, SurveyImage, SurveyResult, SurveySettings, survey_body
from robcal.transforms import retract, transform
from tests.photogrammetry.networks import Truth, aligned_error, detections, make_network

SIZE = (2400, 1800)


def plate(seed: int, coded: int = 12, **more: object) -> tuple[Truth, np.random.Generator]:
    """A plate whose first ``coded`` targets (spread over it) carry codes."""
    rng = np.random.default_rng(seed)
    truth = make_network(rng, **{"images": 14, "targets": 40, **more})  # type: ignore[arg-type]
    return shuffled(truth, rng), rng


def shuffled(truth: Truth, rng: np.random.Generator) -> Truth:
    """Targets in random order, so that the coded ones are not all in a corner."""
    order = rng.permutation(len(truth.points))
    place = np.argsort(order)
    return replace(
        truth,
        points=truth.points[order],
        normals=truth.normals[order],
        marks=replace(truth.marks, target=place[truth.marks.target]),
    )


def listed(truth: Truth, coded: int, *, xyz: bool = False) -> list[BodyTarget]:
    out = []
    for i, p in enumerate(truth.points):
        known = tuple(map(float, p)) if xyz else None
        diameter = truth.diameter or None
        out.append(BodyTarget(100 + i if i < coded else 1000 + i, "ring12" if i < coded else None, diameter, known))
    return out


def bars(truth: Truth, *pairs: tuple[int, int], sigma: float = 3e-6) -> Lengths:
    lengths = [float(np.linalg.norm(truth.points[i] - truth.points[j])) for i, j in pairs]
    return Lengths([[100 + i, 100 + j] for i, j in pairs], lengths, [sigma] * len(pairs))


def nearest_truth(result: SurveyResult, truth: Truth, coded: int) -> tuple[np.ndarray, np.ndarray]:
    """Row of the true target nearest to each surveyed one after a fit on the coded ones, and the distances."""
    net = result.network
    ids = [int(i) for i in net.ids if 100 <= i < 100 + coded]
    fit = fit_similarity(net.points[net.index_of(ids)], truth.points[np.array(ids) - 100], with_scale=False)
    distance = np.linalg.norm(net.points[:, None] - fit.points(truth.points)[None], axis=2)
    return distance.argmin(axis=1), distance.min(axis=1)


@pytest.mark.parametrize(
    ("seed", "body", "images", "targets", "coded", "factor"),
    [(1, "plate", 14, 40, 10, 1.3), (2, "plate", 20, 60, 8, 2.5), (3, "sphere", 50, 70, 40, 1.4)],
)
def test_uncoded_dots_are_found_without_any_start_values(
    seed: int, body: str, images: int, targets: int, coded: int, factor: float
) -> None:
    rng = np.random.default_rng(seed)
    truth = shuffled(make_network(rng, body, images=images, targets=targets, focal_factor=factor), rng)
    pairs = ((0, 1), (2, 3))
    result = survey_body(
        detections(truth, coded, rng, clutter=4), listed(truth, coded), size=SIZE, scale_bars=bars(truth, *pairs)
    )
    net = result.network
    row, distance = nearest_truth(result, truth, coded)
    assert len(set(row.tolist())) == len(net.ids)  # nothing found twice
    assert len(net.ids) >= 0.97 * targets
    assert distance.max() < 1e-3  # nothing invented
    for i, r in zip(net.ids, row, strict=True):
        assert i >= 1000 or r == i - 100  # codes keep their target
    assert set(net.ids.tolist()) <= {t.id for t in listed(truth, coded)}
    e = aligned_error(net.points, truth.points[row], scale=False).ravel()
    nees = e @ np.linalg.pinv(net.points_covariance, rcond=1e-10, hermitian=True) @ e / (e.size - 6)
    assert 0.6 < nees < 1.5
    assert 0.9 < net.sigma0 < 1.1
    assert len(net.rejected) <= 3


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.6, 2.5, 4.0])
def test_self_calibration_from_the_image_size_alone(factor: float) -> None:
    truth, rng = plate(int(10 * factor), coded=16, targets=16, images=12, focal_factor=factor)
    result = survey_body(detections(truth, 16, rng), listed(truth, 16), size=SIZE, scale_bars=bars(truth, (0, 1)))
    net = result.network
    d = net.camera.vector - truth.camera.vector
    free = np.diag(net.intrinsics_covariance) > 0
    d, C = d[free], net.intrinsics_covariance[np.ix_(free, free)]
    assert len(net.image_names) == 12
    assert abs(net.camera.fx / truth.camera.fx - 1.0) < 0.005
    if free.all():
        assert d @ np.linalg.solve(C, d) / len(d) < 4.0


def test_given_coordinates_define_frame_and_scale() -> None:
    truth, rng = plate(20, coded=15, targets=30)
    moved = retract(np.eye(4), [0.4, -2.0, 0.7, 0.3, -0.5, 2.0])
    given = transform(moved, truth.points)
    targets = listed(replace(truth, points=given), 15, xyz=True)
    result = survey_body(detections(truth, 15, rng), targets, size=SIZE)
    net = result.network
    assert "given coordinates" in result.frame
    assert result.scale == "the given coordinates"
    # uncoded targets with coordinates get their own ids
    true = {t.id: np.array(t.xyz) for t in targets}
    error = np.array([p - true[int(i)] for i, p in zip(net.ids, net.points, strict=True)])
    assert len(net.ids) == 30
    assert np.abs(error).max() < 3e-4
    assert max(d for _, d in result.deviations) < 3e-4


def test_given_coordinates_do_not_bend_the_body_when_bars_give_the_scale() -> None:
    truth, rng = plate(21, coded=20, targets=20)
    nominal = truth.points + rng.normal(0, 5e-4, truth.points.shape)
    targets = listed(replace(truth, points=nominal * 1.01), 20, xyz=True)
    result = survey_body(detections(truth, 20, rng), targets, size=SIZE, scale_bars=bars(truth, (0, 1), (2, 3)))
    e = aligned_error(result.network.points, truth.points, scale=False)
    assert np.sqrt(np.mean(e**2)) < 3e-5
    assert max(d for _, d in result.deviations) > 1e-3


def test_without_coordinates_centroid_and_principal_directions() -> None:
    truth, rng = plate(22, coded=20, targets=20)
    result = survey_body(detections(truth, 20, rng), listed(truth, 20), size=SIZE, scale_bars=bars(truth, (0, 1)))
    p = result.network.points
    assert "principal" in result.frame
    np.testing.assert_allclose(p.mean(axis=0), 0.0, atol=1e-5)
    spread = p.T @ p
    assert spread[0, 0] > spread[1, 1] > spread[2, 2]
    np.testing.assert_allclose(spread - np.diag(np.diag(spread)), 0.0, atol=1e-5)
    # cameras stand on the side of +z
    R, t = result.network.camera_T_body[:, :3, :3], result.network.camera_T_body[:, :3, 3]
    assert (-np.einsum("nij,ni->nj", R, t)[:, 2] > 0).all()


def test_new_dots_get_ids_of_their_own() -> None:
    truth, rng = plate(23, coded=12, targets=25)
    coded_only = [t for t in listed(truth, 12) if t.code]
    result = survey_body(detections(truth, 12, rng), coded_only, size=SIZE, scale_bars=bars(truth, (0, 1)))
    assert len(result.new_ids) == 13
    assert min(result.new_ids) > 4095
    assert set(result.new_ids) <= set(result.network.ids.tolist())


def test_fixed_datum_and_bars_datum() -> None:
    truth, rng = plate(24, coded=20, targets=20)
    targets = listed(truth, 20, xyz=True)
    fixed = (100, 105, 111)
    images = detections(truth, 20, rng)
    net = survey_body(images, targets, size=SIZE, datum=fixed).network
    np.testing.assert_allclose(net.points[net.index_of(fixed)], truth.points[[0, 5, 11]], atol=1e-12)
    assert "fixed" in net.datum
    four = bars(truth, (0, 5), (5, 11))
    assert (
        "scale bars" in survey_body(images, listed(truth, 20), size=SIZE, scale_bars=four, datum="bars").network.datum
    )
    one = survey_body(images, listed(truth, 20), size=SIZE, scale_bars=bars(truth, (0, 5)), datum="bars")
    assert any("one line" in note for note in one.notes)


@pytest.mark.parametrize("diameter", [0.0, 0.04])
def test_both_engines_agree(diameter: float) -> None:
    truth, rng = plate(25, coded=24, targets=24, distortion=(-0.1, 0.05, 2e-4, -1e-4, 0.0), diameter=diameter)
    images, targets = detections(truth, 24, rng), listed(truth, 24)
    settings = SurveySettings(
        free_intrinsics=("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"), adjust=AdjustSettings(tolerance=1e-12)
    )
    results = [
        survey_body(
            images,
            targets,
            size=SIZE,
            scale_bars=bars(truth, (0, 1)),
            engine=engine,
            settings=settings,  # type: ignore[arg-type]
        )
        for engine in ("robcal", "pycolmap")
    ]
    a, b = (r.network for r in results)
    assert [r.engine for r in results] == ["robcal", "pycolmap"]
    sigma = np.sqrt(np.diag(a.intrinsics_covariance))
    free = sigma > 0
    np.testing.assert_allclose((a.camera.vector - b.camera.vector)[free] / sigma[free], 0.0, atol=0.02)
    np.testing.assert_allclose((a.points - b.points) / a.points_sigma, 0.0, atol=0.05)
    np.testing.assert_allclose(a.points_sigma, b.points_sigma, rtol=0.01)
    np.testing.assert_allclose(a.sigma0_px, b.sigma0_px, rtol=1e-4)


def test_wrong_ids_and_swapped_codes_do_not_spoil_it() -> None:
    truth, rng = plate(26, coded=20, targets=20)
    images = detections(truth, 20, rng)
    swapped = []
    for j in (2, 7, 9):
        found = images[j].detections
        code = found.code.copy()  # type: ignore[union-attr]
        code[[0, 1]] = code[[1, 0]]
        swapped.append(code[[0, 1]])
        images[j] = replace(images[j], detections=SimpleNamespace(**{**vars(found), "code": code}))  # type: ignore[arg-type]
    result = survey_body(images, listed(truth, 20), size=SIZE, scale_bars=bars(truth, (0, 1)))
    out = {(r.image, r.target) for r in result.network.rejected}
    for j, codes in zip((2, 7, 9), swapped, strict=True):
        assert {(f"img{j:03d}.png", int(c)) for c in codes} <= out
    assert np.sqrt(np.mean(aligned_error(result.network.points, truth.points, scale=False) ** 2)) < 3e-5


def test_useless_images_are_left_out_with_their_reason() -> None:
    truth, rng = plate(27, coded=20, targets=20)
    images = detections(truth, 20, rng)
    rows = vars(images[0].detections)

    def part(count: int) -> SimpleNamespace:
        return SimpleNamespace(**{k: (v[:count] if k != "message" else v) for k, v in rows.items()})

    black = SimpleNamespace(**{**vars(part(0)), "message": "the image is black"})
    noise = SimpleNamespace(
        xy=rng.uniform(50, 1700, (18, 2)),
        covariance=np.tile(np.eye(2) * 0.01, (18, 1, 1)),
        semi_axes=np.full((18, 2), 8.0),
        angle=np.zeros(18),
        kind=np.zeros(18),
        code=np.arange(100, 118),
        message="",
    )
    extra = [
        SurveyImage("copy.png", images[3].detections),
        SurveyImage("few.png", part(2)),  # type: ignore[arg-type]
        SurveyImage("black.png", black),  # type: ignore[arg-type]
        SurveyImage("other.png", noise),  # type: ignore[arg-type]
    ]
    result = survey_body([*images, *extra], listed(truth, 20), size=SIZE, scale_bars=bars(truth, (0, 1)))
    reasons = dict(result.unused_images)
    assert set(reasons) == {"copy.png", "few.png", "black.png", "other.png"}
    assert "img003.png" in reasons["copy.png"]
    assert "2 identified" in reasons["few.png"]
    assert reasons["black.png"] == "the image is black"
    assert "do not fit" in reasons["other.png"]
    assert len(result.network.image_names) == 14


def test_a_plate_of_circles_with_known_diameter() -> None:
    truth, rng = plate(28, coded=10, targets=25, diameter=0.03, sigma=0.02, images=12)
    result = survey_body(detections(truth, 10, rng), listed(truth, 10), size=SIZE, scale_bars=bars(truth, (0, 1)))
    row, _ = nearest_truth(result, truth, 10)
    e = aligned_error(result.network.points, truth.points[row], scale=False).ravel()
    net = result.network
    nees = e @ np.linalg.pinv(net.points_covariance, rcond=1e-10, hermitian=True) @ e / (e.size - 6)
    assert (net.radii == 0.015).all()
    assert 0.5 < nees < 1.6


@pytest.mark.parametrize("stated", [True, False])
def test_bars_whose_targets_state_no_diameter_do_not_bias_the_scale(stated: bool) -> None:
    truth, rng = plate(31, coded=25, targets=25, diameter=0.05, sigma=0.01, images=20)
    targets = [replace(t, diameter=None) if i < 2 and not stated else t for i, t in enumerate(listed(truth, 25))]
    result = survey_body(detections(truth, 25, rng), targets, size=SIZE, scale_bars=bars(truth, (0, 1), sigma=1e-6))
    net = result.network
    e = aligned_error(net.points, truth.points, scale=False)
    factor = 1.0 + np.sum(e * net.points) / np.sum((net.points - net.points.mean(axis=0)) ** 2)
    assert abs(factor - 1.0) < 10e-6
    np.testing.assert_allclose(net.radii, 0.025, rtol=0.01)


def test_large_dots_on_the_faces_of_a_cube() -> None:
    rng = np.random.default_rng(32)
    truth = make_network(rng, "cube", images=50, targets=30, diameter=0.03, sigma=0.02)
    result = survey_body(detections(truth, 30, rng), listed(truth, 30), size=SIZE, scale_bars=bars(truth, (0, 3)))
    net = result.network
    e = aligned_error(net.points, truth.points[net.ids - 100], scale=False).ravel()
    nees = e @ np.linalg.pinv(net.points_covariance, rcond=1e-10, hermitian=True) @ e / (e.size - 6)
    assert 0.5 < nees < 1.6
    turned = np.abs(np.einsum("ti,ti->t", net.normals, _turned_normals(net, truth)))
    assert np.degrees(np.arccos(np.clip(turned, 0, 1))).max() < 2.0


def _turned_normals(net: CameraNetwork, truth: Truth) -> np.ndarray:
    """The true normals in the frame of the surveyed body."""
    rows = net.ids - 100
    a, b = net.points - net.points.mean(axis=0), truth.points[rows] - truth.points[rows].mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    turn = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return np.asarray(truth.normals[rows] @ turn.T)


def test_a_scale_that_contradicts_coordinates_or_sizes_is_a_wrong_unit() -> None:
    truth, rng = plate(33, coded=20, targets=20, diameter=0.02, images=8)
    images = detections(truth, 20, rng)
    metres = bars(truth, (0, 1))
    metres = Lengths(metres.ids, metres.length / 1000, metres.sigma)
    with pytest.raises(InvalidInput, match=r"0\.001 times as large as its coordinates.*millimetres"):
        survey_body(images, listed(truth, 20, xyz=True), size=SIZE, scale_bars=metres)
    with pytest.raises(InvalidInput, match=r"0\.001 times as large as their diameters.*millimetres"):
        survey_body(images, listed(truth, 20), size=SIZE, scale_bars=metres)
    check = bars(truth, (2, 3))
    check = Lengths(check.ids, check.length * 1000, check.sigma)
    with pytest.raises(InvalidInput, match=r"check length 102-103.*0\.001 times.*millimetres"):
        survey_body(images, listed(truth, 20), size=SIZE, scale_bars=bars(truth, (0, 1)), check_lengths=check)


def test_errors_name_the_cause_and_the_remedy() -> None:
    truth, rng = plate(29, coded=20, targets=20, images=8)
    images, targets, bar = detections(truth, 20, rng), listed(truth, 20), bars(truth, (0, 1))
    with pytest.raises(NotIdentifiable, match="scale bar") as caught:
        survey_body(images, targets, size=SIZE)
    assert caught.value.parameters == ("scale",)
    with pytest.raises(DegenerateGeometry, match="of 1 images"):
        survey_body(images[:1], targets, size=SIZE, scale_bars=bar)
    with pytest.raises(InvalidInput, match="1000 x 800"):
        survey_body(images, targets, size=SIZE, scale_bars=bar, camera=Camera.from_size(1000, 800))
    with pytest.raises(InvalidInput, match="engine"):
        survey_body(images, targets, size=SIZE, scale_bars=bar, engine="other")  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="same name"):
        survey_body([images[0], images[0]], targets, size=SIZE, scale_bars=bar)
    with pytest.raises(InvalidInput, match="twice"):
        survey_body(images, [*targets, targets[0]], size=SIZE, scale_bars=bar)
    with pytest.raises(InvalidInput, match="no coordinates"):
        survey_body(images, targets, size=SIZE, datum=(100, 101, 102))
    with pytest.raises(InvalidInput, match="999"):
        survey_body(images, targets, size=SIZE, scale_bars=Lengths([[100, 999]], [1.0], [1e-5]))
    wrong = replace(bars(truth, (0, 1), (2, 3)))
    wrong = replace(wrong, length=wrong.length + np.array([0.0, 2e-3]))
    with pytest.raises(InvalidInput, match="contradict each other"):
        survey_body(images, targets, size=SIZE, scale_bars=wrong)
    noise = [
        SurveyImage(f"n{j}", marks=(np.arange(12), rng.uniform(0, 1700, (12, 2)), np.tile(np.eye(2), (12, 1, 1))))
        for j in range(3)
    ]
    with pytest.raises((DegenerateGeometry, NotIdentifiable)):
        survey_body(noise, [], size=SIZE, scale_bars=Lengths([[0, 1]], [1.0], [1e-5]))

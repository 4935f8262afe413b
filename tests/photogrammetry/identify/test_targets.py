"""Identification: codes, prediction, geometry alone, and the refusal of symmetric arrangements."""

from types import SimpleNamespace

import numpy as np
import pytest

from robcal.imaging.detections import TargetKind
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera, project
from robcal.photogrammetry.identify.extension import Prediction, predict_dots
from robcal.photogrammetry.identify.targets import identify_images, identify_targets
from robcal.photogrammetry.orientation.resection import resect
from robcal.photogrammetry.station.identify import identify_station, spread_order
from robcal.transforms import exp_so3, frame, invert, retract, transform
from tests.photogrammetry.stations import PLATE, simulate

CAMERA = Camera(2448, 2048, 3600.0, 3600.0, 1220.0, 1030.0, -0.08, 0.05, 2e-4, -1e-4, 0.0)
ROUGH = Camera(2448, 2048, 3500.0, 3500.0, 1223.5, 1023.5)
POSE = frame(exp_so3([0.3, -0.2, 1.0]), [0.05, -0.1, 2.2])


def _detections(body, camera, camera_T_body, coded, rng, distractors):
    """Dots of a body and others at random, in random order; returns them and the true id of each (-1: distractor)."""
    p = transform(camera_T_body, body.points)
    xy = project(camera, p) + rng.normal(size=(len(p), 2)) * 0.02
    size = np.r_[camera.fx * 0.006 / p[:, 2], rng.uniform(2, 15, distractors)]
    xy = np.r_[xy, rng.uniform([0, 0], [2448, 2048], (distractors, 2))]
    truth = np.r_[body.ids, -np.ones(distractors, dtype=int)]
    code = np.r_[np.where(coded, body.ids, -1), -np.ones(distractors, dtype=int)]
    order = rng.permutation(len(xy))
    d = SimpleNamespace(
        shape=(2048, 2448),
        xy=xy[order],
        covariance=np.tile(np.eye(2) * 4e-4, (len(xy), 1, 1)),
        semi_axes=np.column_stack([size, 0.8 * size])[order],
        contrast=np.full(len(xy), 100.0),
        code=code[order],
        kind=np.where(code[order] >= 0, TargetKind.RING12, TargetKind.DOT),
    )
    return d, truth[order]


def _body(points, coded=None):
    t = len(points)
    codes = tuple("ring12" if c else None for c in (np.zeros(t, bool) if coded is None else coded))
    return Body("plate", 7 * np.arange(1, t + 1), np.asarray(points, float), None, codes, np.full(t, 0.012))


def test_codes_extend_to_uncoded_dots():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.3, 0.3, (20, 2)), np.zeros(20)])
    coded = np.arange(20) < 6
    body = _body(points, coded)
    d, truth = _detections(body, CAMERA, POSE, coded, rng, 10)
    d.code[np.flatnonzero(d.code == 7)] = -1  # one code unreadable: then it is a dot like the others
    found = identify_targets(d, body, ROUGH)
    assert found.method == "codes"
    assert np.array_equal(truth[found.rows], found.ids)
    assert len(found.ids) >= 18


def test_misread_code_is_thrown_out():
    rng = np.random.default_rng(1)
    body = _body(np.column_stack([rng.uniform(-0.3, 0.3, (10, 2)), np.zeros(10)]), np.ones(10, bool))
    d, truth = _detections(body, CAMERA, POSE, np.ones(10, bool), rng, 0)
    a, b = np.flatnonzero(d.code == 7)[0], np.flatnonzero(d.code == 70)[0]
    d.code[[a, b]] = d.code[[b, a]]
    found = identify_targets(d, body, ROUGH)
    assert np.array_equal(truth[found.rows], found.ids)
    assert len(found.ids) >= 8


@pytest.mark.parametrize("distractors", [0, 8])
def test_five_uncoded_dots(distractors):
    rng = np.random.default_rng(2)
    body = _body(PLATE)
    for tilt in ([0.3, -0.2, 1.0], [-0.4, 0.3, -2.0], [0.1, 0.5, 3.0]):
        d, truth = _detections(body, CAMERA, frame(exp_so3(tilt), [0, 0, 2.5]), np.zeros(5, bool), rng, distractors)
        found = identify_targets(d, body, ROUGH)
        assert found.method == "search"
        assert np.array_equal(truth[found.rows], found.ids)
        assert len(found.ids) == 5


def test_symmetric_arrangement_is_refused_and_prediction_resolves_it():
    rng = np.random.default_rng(3)
    body = _body([[0, 0, 0], [0.2, 0, 0], [0.2, 0.2, 0], [0, 0.2, 0], [0.1, 0.1, 0]])
    d, truth = _detections(body, CAMERA, POSE, np.zeros(5, bool), rng, 2)
    found = identify_targets(d, body, ROUGH)
    assert found.method == "none"
    assert "symmetric" in found.reason
    near = retract(POSE, [0.002, -0.001, 0.003, 0.002, 0.001, -0.002])
    found = identify_targets(d, body, CAMERA, predictions=[Prediction(near, None, 4.0)])
    assert found.method == "prediction"
    assert np.array_equal(truth[found.rows], found.ids)
    assert len(found.ids) == 5


def test_dots_of_something_else_are_refused():
    rng = np.random.default_rng(4)
    body = _body(PLATE)
    d, truth = _detections(body, CAMERA, POSE, np.zeros(5, bool), rng, 9)
    keep = truth < 0
    for name in ("xy", "covariance", "semi_axes", "code", "kind"):
        setattr(d, name, getattr(d, name)[keep])
    found = identify_targets(d, body, ROUGH)
    assert len(found.ids) == 0
    assert found.reason


def test_station_of_uncoded_dots():
    rng = np.random.default_rng(5)
    s = simulate(poses=8)
    body = Body("plate", s.body.ids, s.body.points, s.body.covariance, (None,) * 5, np.full(5, 0.012))
    detections, truth = {}, {}
    for name, camera in s.cameras.items():
        detections[name] = {}
        for pose in range(8):
            T = invert(s.world_T_camera[name]) @ s.world_T_body[pose]
            detections[name][pose], truth[name, pose] = _detections(body, camera, T, np.zeros(5, bool), rng, 5)
    result = identify_station(detections, body, s.rough)
    assert not result.problems
    for key, image in result.images.items():
        assert np.array_equal(truth[key][image.rows], image.ids)
    assert sum(len(m) for m in result.marks.values()) >= 78


def test_many_images_at_once_are_as_one_by_one():
    rng = np.random.default_rng(6)
    coded = np.arange(30) < 8
    body = _body(np.column_stack([rng.uniform(-0.3, 0.3, (30, 2)), np.zeros(30)]), coded)
    images, truths = [], []
    for _ in range(5):
        pose = frame(exp_so3(rng.uniform(-0.4, 0.4, 3)), [*rng.uniform(-0.1, 0.1, 2), 2.2])
        d, truth = _detections(body, CAMERA, pose, coded, rng, 10)
        images.append(d)
        truths.append(truth)
    images[3].code[:] = -1  # no code at all: by the prediction given
    predictions = [(), (), (), (Prediction(pose_of(body, CAMERA, images[3], truths[3]), None, 4.0),), ()]
    together = identify_images(images, body, ROUGH, predictions=predictions)
    assert [image.method for image in together] == ["codes", "codes", "codes", "prediction", "codes"]
    for d, truth, expected, image in zip(images, truths, predictions, together, strict=True):
        alone = identify_targets(d, body, ROUGH, predictions=expected)
        assert np.array_equal(np.sort(image.rows), np.sort(alone.rows))
        assert np.array_equal(truth[image.rows], image.ids)


def pose_of(body, camera, detections, truth):
    """Pose from the true numbers, as another camera would predict it."""
    rows = np.flatnonzero(truth >= 0)
    fit = resect(camera, truth[rows], detections.xy[rows], detections.covariance[rows], body)
    return retract(fit.camera_T_body, [0.001, -0.001, 0.002, 0.001, 0.001, -0.001])


@pytest.mark.slow
def test_second_round_finds_what_the_rough_cameras_missed():
    rng = np.random.default_rng(7)
    s = simulate(poses=8)
    coded = np.arange(60) < 12
    body = _body(np.column_stack([rng.uniform(-0.35, 0.35, (60, 2)), np.zeros(60)]), coded)
    detections, truth = {}, {}
    for name, camera in s.cameras.items():
        detections[name] = {}
        for pose in range(8):
            T = invert(s.world_T_camera[name]) @ s.world_T_body[pose]
            d, truth[name, pose] = _detections(body, camera, T, coded, rng, 20)
            if (name, pose) == ("left", 3):
                d.code[:] = -1
            detections[name][pose] = d
    result = identify_station(detections, body, s.rough)
    image = result.images["left", 3]
    assert image.method == "prediction"
    for key, found in result.images.items():
        assert np.array_equal(truth[key][found.rows], found.ids)
        assert len(found.ids) >= 55


def test_spread_order_takes_the_far_points_first():
    points = np.array([[0.0, 0, 0], [0.1, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 0.5, 0], [np.nan] * 3])
    order = spread_order(points, np.isfinite(points).all(axis=1))
    assert set(order[:4]) == {0, 2, 3, 4}
    assert order[4] == 5
    assert sorted(order) == [0, 1, 2, 3, 4, 5]


def test_parts_of_a_code_ring_are_not_taken_for_its_dot():
    points = np.column_stack([np.linspace(-0.2, 0.2, 6), np.linspace(-0.1, 0.1, 6) ** 2, np.zeros(6)])
    body = _body(points, np.arange(6) < 5)
    _, gate, size = predict_dots(CAMERA, POSE, None, body, np.arange(6), 4.0)
    assert (gate[:5] < 1.3 * size[:5]).all()  # parts of the ring lie from two radii on
    assert gate[5] == pytest.approx(20.0)  # what is but a dot may be anywhere near


def test_codes_that_every_image_contradicts_stay_for_the_adjustment_to_judge():
    rng = np.random.default_rng(8)
    points = np.column_stack([rng.uniform(-0.2, 0.2, (12, 2)), rng.uniform(0.0, 0.05, 12)])
    body = _body(points, np.ones(12, bool))
    poses = [
        frame(exp_so3(rng.normal(0, 0.2, 3)) @ POSE[:3, :3], POSE[:3, 3] + rng.normal(0, 0.1, 3)) for _ in range(8)
    ]
    first, second, once = body.ids[2], body.ids[7], body.ids[4]
    images = {}
    for k, pose in enumerate(poses):
        d, _ = _detections(body, CAMERA, pose, np.ones(12, bool), rng, 0)
        d.code[:] = np.select([d.code == first, d.code == second], [second, first], d.code)
        if k == 0:  # a code misread in one image only is no more than that
            d.xy[d.code == once] += 60.0
        images[k] = d
    marks = identify_station({"left": images}, body, {"left": CAMERA}).marks["left"]
    assert np.count_nonzero(marks.target == first) == np.count_nonzero(marks.target == second) == 8
    assert np.count_nonzero(marks.target == once) == 7

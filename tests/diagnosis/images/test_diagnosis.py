"""Every cause that shows in images is found, named and sized; where nothing is missing nothing is said."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.diagnosis.images.diagnosis import _moving_alike, diagnose_images, spread_of_others
from robcal.diagnosis.images.exchange import exchanged_targets
from robcal.photogrammetry.core.eccentricity import centre_shift
from robcal.physics.images.data import survey_data
from tests.diagnosis.image_scenes import reported, station, survey


def _named(finding, effect):
    return (effect.cause, effect.where) in {(finding.name, finding.where), *_rivals(finding)}


def _rivals(finding):
    return [(kind.name, where) for kind, where in finding.rivals]


@pytest.mark.parametrize("cause", ["target_shifted", "refraction", "body_thermal_growth"])
def test_cause_of_a_station_is_found_and_named(cause):
    scene = station(cause, snr=9.0, seed=3, targets=20)
    found = reported(scene)
    assert [f.name for f in found] == [cause]
    assert _named(found[0], scene.effects[0])
    assert found[0].p_value < 0.01
    assert found[0].heldout_px[1] < found[0].heldout_px[0]


def test_small_move_of_a_camera_is_told_with_its_rival():
    scene = station("camera_moved", snr=8.0, seed=2, views=20)
    assert not scene.orientation.evidence  # too small for the adjustment to act by itself
    found = diagnose_images(scene.data).findings
    assert [f.name for f in found] == ["camera_moved"]
    assert _named(found[0], scene.effects[0])


def test_growth_has_the_right_size():
    scene = station("body_thermal_growth", snr=20.0, seed=4)
    (found,) = diagnose_images(scene.data).findings
    true = scene.effects[0].value("um_per_m_K")
    assert abs(found.parameters["um_per_m_K"] - true) < 4.0 * found.sigma["um_per_m_K"]
    assert ("scale_drift", "station") in _rivals(found)


@pytest.mark.parametrize("snr", [7.5, 30.0])
def test_shift_of_a_target_has_the_right_size(snr):
    scene = station("target_shifted", snr=snr, seed=5, targets=20)
    (found,) = reported(scene)
    true = np.array(scene.effects[0].vector("shift_mm"))
    assert np.all(np.abs(np.array(found.parameters["shift_mm"]) - true) < 4.0 * np.array(found.sigma["shift_mm"]))


def test_exchanged_targets_are_told_as_such():
    scene = station("target_swapped", seed=6)
    (found,) = exchanged_targets(scene.orientation, scene.marks, scene.given)
    effect = scene.effects[0]
    pair = {int(found.where), found.parameters["with"]}
    assert pair == {int(effect.where), int(effect.parameters["with"])}
    assert not exchanged_targets(*[getattr(station(seed=6), name) for name in ("orientation", "marks", "given")])


@pytest.mark.parametrize("stated_factor", [0.85, 1.0, 1.15])
def test_nothing_missing_in_a_station(stated_factor):
    quiet = [diagnose_images(station(seed=50 + s, stated_factor=stated_factor).data) for s in range(3)]
    assert not any(d.findings for d in quiet)
    assert min(d.p_value for d in quiet) > 1e-3


def test_nothing_missing_in_a_survey():
    for seed in range(3):
        done, _ = survey(seed=70 + seed)
        found = diagnose_images(survey_data(done.network, None, "survey", dots=False))
        assert not found.findings


def test_body_less_accurate_than_stated_is_no_crowd_of_shifted_targets():
    """All coordinates wrong by ten times their stated sigma: no single target stands out."""
    from robcal.diagnosis.images.station import station_data
    from robcal.photogrammetry.core.bodies import Body

    scene = station(seed=8)
    rng = np.random.default_rng(1)
    wrong = Body(
        "plate",
        scene.given.ids,
        scene.given.points + 2e-5 * rng.standard_normal(scene.given.points.shape),
        scene.given.covariance,
        scene.given.codes,
        scene.given.diameters,
    )
    data = station_data(scene.orientation, scene.names, wrong, dict.fromkeys(scene.orientation.names))
    assert not [f for f in diagnose_images(data).findings if f.name == "target_shifted"]


def test_station_rows_are_an_orthogonal_projection():
    """The adjusted residuals lie where nothing is left to absorb, and removing twice is removing once."""
    data = station(seed=9).data
    assert np.allclose(data.remove(data.residual), data.residual, atol=1e-8)
    columns = np.random.default_rng(0).standard_normal((len(data.residual), 3))
    once = data.remove(columns)
    assert np.allclose(data.remove(once), once, atol=1e-8)
    assert np.allclose(once.T @ columns, once.T @ once, atol=1e-7)
    assert abs(data.residual @ data.residual / data.freedom - 1.0) < 0.2


def test_spread_of_targets_is_not_spoilt_by_the_displaced_one() -> None:
    rng = np.random.default_rng(5)
    model = np.linalg.qr(rng.standard_normal((60, 12)))[0]  # few targets: each shift shows in the others' tests too
    shifts = [rng.standard_normal((60, 3)) + 2.0 * rng.standard_normal((60, 1)) for _ in range(5)]
    bases = [np.linalg.qr(s - model @ (model.T @ s))[0] for s in shifts]
    noise = rng.standard_normal(60)
    residual = noise - model @ (model.T @ noise)
    clean = spread_of_others(bases, residual)
    spoilt = spread_of_others(bases, residual + bases[2] @ np.array([40.0, -30.0, 20.0]))
    assert clean < 3.0
    assert spoilt < 3.0


def _dots(seed: int, **plan: int):
    """A healthy station whose targets are round dots of unknown size, facing along the body's z."""
    data = station(seed=seed, targets=20, views=30, **plan).data
    return replace(data, dots=True, normal_camera=data.camera_R_body[:, :, 2], radii=np.zeros(len(data.xy)))


def _displaced(data, shift):
    return replace(data, residual=data.residual + data.remove(data.whiten(shift[:, :, None]))[:, 0])


def _eccentric(data, radius):
    shift = np.zeros_like(data.xy)
    for c, camera in enumerate(data.cameras):
        rows = data.camera == c
        size = np.full(rows.sum(), radius)
        shift[rows] = centre_shift(camera, data.p_camera[rows], data.normal_camera[rows], size)
    return shift


def test_dots_of_unstated_size_have_one_diameter_for_all_cameras():
    data = _dots(11)
    found = diagnose_images(_displaced(data, _eccentric(data, 0.02))).findings
    assert [(f.name, f.stage, f.where) for f in found] == [
        ("ellipse_eccentricity", "image", name) for name in data.names
    ]
    assert len({f.parameters["diameter_mm"] for f in found}) == 1
    assert abs(found[0].parameters["diameter_mm"] - 40.0) < 4.0 * found[0].sigma["diameter_mm"]
    assert found[0].rivals == ()
    assert data.names[1] in found[1].statement


def test_causes_are_estimated_beside_each_other():
    data = _dots(11)
    bias = 0.3 * (data.camera == 0)[:, None] * data.normal_camera[:, :2]
    found = diagnose_images(_displaced(data, _eccentric(data, 0.02) + bias)).findings
    by_cause = {f.name: f for f in found}
    assert set(by_cause) == {"ellipse_eccentricity", "centroid_bias"}
    dots, biased = by_cause["ellipse_eccentricity"], by_cause["centroid_bias"]
    assert abs(dots.parameters["diameter_mm"] - 40.0) < 4.0 * dots.sigma["diameter_mm"]
    # found first, its first estimate has the other's share in it: six standard deviations
    assert abs(biased.parameters["px"] - 0.3) < 4.0 * biased.sigma["px"]


def test_centres_displaced_along_the_tilt_of_dots():
    data = _dots(12)
    rows = data.camera == 0
    (found,) = diagnose_images(_displaced(data, 0.3 * rows[:, None] * data.normal_camera[:, :2])).findings
    assert (found.name, found.stage, found.where) == ("centroid_bias", "image", data.names[0])
    assert abs(found.parameters["px"] - 0.3) < 4.0 * found.sigma["px"]


def test_dots_of_a_healthy_station_have_no_bias():
    assert not diagnose_images(_dots(13)).findings


def test_dots_that_move_together_are_no_set_of_shifted_targets():
    """Dots on posts whose rims bias all their centres alike: nothing was moved, and it is not silent either."""
    scene = station("target_shifted", snr=7.5, seed=5, targets=20)
    (found,) = diagnose_images(scene.data).findings
    height = np.array([0.0, 0.0, 0.024])
    posts = [
        replace(found, where=str(k), parameters={"shift_mm": (height * size + [0.001 * k, 0, 0]).tolist()})
        for k, size in enumerate((0.9, 1.0, 1.1))
    ]
    elsewhere = replace(found, where="9", parameters={"shift_mm": [0.03, 0.0, 0.0]})
    assert _moving_alike([*posts, elsewhere]) == posts
    assert _moving_alike([*posts[:2], elsewhere]) == []
    assert _moving_alike([*posts[:2], replace(posts[2], parameters={"shift_mm": [0.0, 0.0, 0.24]})]) == []

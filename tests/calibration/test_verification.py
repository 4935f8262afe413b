"""Verification: the thesis' table, honest normalised errors, folds, ISO terms."""

import numpy as np
import pytest

from robcal import transforms as tf
from robcal.calibration.identifiability import repetitions
from robcal.calibration.identification import IdentifyOptions, identify
from robcal.calibration.observations import FrameObservations, PointObservations
from robcal.calibration.verification import ErrorStatistics, cross_validate, fit_nominal, tool_errors, verify
from robcal.errors import NotIdentifiable
from tests.calibration.scenarios import scenario


def test_kept_out_poses_agree_with_the_stated_uncertainty() -> None:
    s = scenario(0)
    observed = s.frames(s.poses)
    robot = identify(s.model, s.poses, [observed])
    result = verify(robot, s.kept_out, [s.frames(s.kept_out)], fit_nominal(s.model, s.poses, [observed]))
    assert result.kind == "verify-set"
    assert result.poses == 200
    assert set(result.tools) == {"0", "500", "1000"}
    assert result.tools["0"].mean < 1.2e-4
    assert result.nominal is not None
    assert result.nominal["0"].mean > 2e-3
    assert result.nominal["1000"].max >= result.nominal["1000"].mean >= result.nominal["1000"].min
    assert result.p_value > 1e-3
    assert 0.9 < result.coverage_95 < 0.99
    assert 0.8 < result.normalised.mean() < 1.2
    assert result.iso is not None
    assert result.iso.ap_mean == pytest.approx(result.tools["0"].mean)
    assert np.isnan(result.iso.rp_mean)


def test_a_model_that_lacks_physics_is_not_honest() -> None:
    s = scenario(1)
    robot = identify(
        s.model, s.poses, [s.frames(s.poses)], IdentifyOptions(parameters="geometry", covariance="stated"), s.kernel
    )
    result = verify(robot, s.kept_out, [s.frames(s.kept_out)])
    assert result.p_value < 1e-6
    assert result.coverage_95 < 0.6
    assert result.nominal is None


def test_repetitions_give_rp_and_stay_in_one_fold() -> None:
    s = scenario(2, n=30)
    q = np.repeat(s.poses.q, 3, axis=0)
    poses = s.kernel.poses(q, "dumbbell")
    labels = repetitions(q)
    assert len(np.unique(labels)) == 30
    observed = s.frames(poses)
    result = cross_validate(s.model, poses, [observed], folds=3)
    assert result.kind == "cross-validation"
    assert sorted(result.rows.tolist()) == list(range(90))
    assert result.iso is not None
    assert 5e-5 < result.iso.rp_mean < 5e-4
    assert 0.85 < result.coverage_95 <= 1.0
    with pytest.raises(NotIdentifiable, match="folds"):
        cross_validate(s.model, poses.subset(np.arange(6)), [observed.subset(np.arange(6))], folds=5)


def test_points_alone_and_empty_statistics() -> None:
    s = scenario(3)
    T = s.truth.frames(s.theta, s.kept_out)
    p = T[:, :3, 3] + [1e-3, 0, 0]
    points = PointObservations(
        np.arange(200), np.zeros((200, 3)), p, np.broadcast_to(np.eye(3), (200, 3, 3)), np.zeros(200)
    )
    ((_, errors),) = tool_errors(T, [points]).values()
    np.testing.assert_allclose(errors, 1e-3)
    assert np.isnan(ErrorStatistics.of([]).mean)
    frames = FrameObservations.isotropic(tf.retract(T, [0, 0, 0, 1e-3, 0, 0]), 1e-4, 1e-4)
    assert tool_errors(T, [frames])["0"][1].max() < 1e-12
    assert tool_errors(T, [frames])["1000"][1].mean() == pytest.approx(1e-3 * np.hypot(0.4, 0.8), rel=1e-3)

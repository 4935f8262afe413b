"""The fit of a robot together with causes ends where robot and causes agree."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robcal.calibration.observations import DistanceObservations
from robcal.diagnosis.core import fitting
from robcal.diagnosis.core.fitting import Accepted, fit
from robcal.diagnosis.findings import recording_data
from robcal.diagnosis.gain.heldout import position_errors, rms
from robcal.physics.measuring import measuring_causes
from tests.diagnosis.recordings import concealed


def test_a_displacement_that_the_robot_nearly_absorbs_is_followed_all_the_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fitting, "LARGEST_STEP", 0.02)  # damped steps alone would end half way
    found, identify, _, _ = concealed(tmp_path, seed=122, effects=[], level="distances")
    plain = fit(found.model, identify, found.names)
    assert isinstance(identify.observations, DistanceObservations)
    length = identify.observations.distance
    offset = replace(identify, observations=replace(identify.observations, distance=length + 0.2))
    # first the robot imitates the offset as far as it can, then the offset is known as such
    imitation = fit(found.model, offset, found.names)
    causes = measuring_causes(recording_data(imitation, offset), (), "")
    cause = next(f for f in causes if f.name == "wire_offset")
    accepted = Accepted(cause, {}, np.zeros(1), np.zeros((1, 1)))
    reported = fit(imitation.model, offset, found.names, (accepted,))
    assert abs(reported.accepted[0].values[0] - 0.2) < 4 * float(np.sqrt(reported.accepted[0].covariance[0, 0]))
    assert rms(position_errors(offset, reported)) < 1.01 * rms(position_errors(identify, plain))
    own = reported.columns_of(reported.accepted[0])
    assert np.array_equal(reported.covariance[np.ix_(own, own)], reported.accepted[0].covariance)
    assert reported.jacobian[:, own].shape == (len(reported.residual), 1)

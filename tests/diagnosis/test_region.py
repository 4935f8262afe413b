"""A region kept out: chosen at the end of the space, its errors predicted from the others."""

from pathlib import Path

import numpy as np
import pytest

from robcal.diagnosis.core.fitting import fit
from robcal.diagnosis.diagnose import diagnose
from robcal.diagnosis.gain.heldout import SHARE, extrapolated, outermost, region_errors
from robcal.recipe.robot_diagnosis import optional_parameters, own_elasticities
from tests.diagnosis.recordings import concealed


def test_the_outermost_poses_lie_at_the_longer_end() -> None:
    frames = np.tile(np.eye(4), (50, 1, 1))
    frames[:, 0, 3] = np.linspace(0.0, 1.0, 50) ** 3
    frames[:, 1, 3] = 0.01 * np.sin(np.arange(50))
    region = outermost(frames)
    assert region.sum() == int(SHARE * 50)
    assert np.all(np.flatnonzero(region) >= 40)


@pytest.mark.slow
def test_what_was_left_out_shows_outside_the_range(tmp_path: Path) -> None:
    found, identify, _, _ = concealed(tmp_path, seed=4, effects=["joint_eccentricity"], snr=25.0)
    result = diagnose(
        found.model,
        identify,
        found.names,
        (*found.eliminated, *own_elasticities(found)),
        None,
        optional=optional_parameters(found),
    )
    assert result.mismatch
    assert result.region is not None
    before, after = result.region
    floor = result.heldout[2]
    assert after**2 - floor**2 < 0.4 * (before**2 - floor**2)


def test_extrapolation_is_no_better_than_the_fit_itself(tmp_path: Path) -> None:
    found, identify, _, _ = concealed(tmp_path, seed=5, effects=[])
    fitted = fit(found.model, identify, found.names)
    region = outermost(fitted.frames)
    inside = identify.unwhiten(fitted.residual[:, None], fitted.frames)[region[identify.observations.pose], :3, 0]
    assert extrapolated(identify, fitted, region) > float(np.sqrt(np.mean(np.sum(inside**2, axis=1))))
    assert region_errors(identify.subset(np.arange(len(identify.q)) < 20), fitted, fitted) is None

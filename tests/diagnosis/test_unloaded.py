"""Joints without load: their elasticity is assumed where a cause may act through it."""

from pathlib import Path

import numpy as np
import pytest

from robcal.calibration.identification import IdentifiedRobot
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.core.result import Diagnosis
from robcal.diagnosis.diagnose import diagnose
from robcal.diagnosis.search.unloaded import unloaded_elasticities
from robcal.recipe.robot_diagnosis import optional_parameters, own_elasticities
from tests.diagnosis.recordings import concealed


def run(found: IdentifiedRobot, recording: Recording, verify: Recording) -> Diagnosis:
    tied = (*found.eliminated, *own_elasticities(found))
    return diagnose(found.model, recording, found.names, tied, verify, optional=optional_parameters(found))


def test_a_vertical_axis_takes_the_value_of_its_neighbour_and_nothing_changes(tmp_path: Path) -> None:
    found, identify, verify, _ = concealed(tmp_path, seed=10073, effects=[])
    assumed = unloaded_elasticities(found.model, identify, found.eliminated)
    assert assumed == {"axis1.elastic_yaw": found.model.parameters["axis2.elastic_pitch"]}
    result = run(found, identify, verify)
    assert not result.mismatch
    assert "axis1.elastic_yaw" not in result.model.parameters


@pytest.mark.slow
def test_a_base_off_the_plumb_line_acts_through_it(tmp_path: Path) -> None:
    found, identify, verify, truth = concealed(tmp_path, seed=10073, effects=["base_tilt"], snr=10.0)
    result = run(found, identify, verify)
    (finding,) = result.findings
    assert finding.cause.name == "base_tilt"
    tilt = truth.plan.effects[0].parameters["tilt_deg"]
    assert abs(float(str(finding.parameters["tilt_deg"])) - tilt) < 4.0 * float(str(finding.sigma["tilt_deg"]))
    assert "axis1.elastic_yaw" in result.free


def test_without_any_known_elasticity_nothing_is_assumed(tmp_path: Path) -> None:
    found, identify, _, _ = concealed(tmp_path, seed=10073, effects=[])
    rigid = found.model.with_parameters({n: 0.0 for n in found.model.parameters if ".elastic_" in n})
    assert unloaded_elasticities(rigid, identify, found.eliminated) == {}
    assert np.isfinite(list(found.values.values())).all()

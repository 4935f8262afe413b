"""Terms of a robot that two instruments watch: those in force pay over folds, in which everything is fitted anew."""

from dataclasses import replace

import numpy as np
import pytest

from robcal import transforms as tf
from robcal.calibration.identification import IdentifyOptions
from robcal.calibration.instruments import IdentifiedInstruments, identify_instruments
from robcal.calibration.joint_log import JointLog
from robcal.recipe.in_force import Form
from robcal.recipe.instruments_in_force import InstrumentFolds, choose_among, contradicted_groups
from robcal.robot.kernel import Kernel
from robcal.robot.model import Term
from tests.calibration.instruments.test_identification import _frames, _instrument, _lengths, _log
from tests.calibration.scenarios import scenario
from tests.robot.chains import kr_like

OPTIONS = IdentifyOptions(("axis2.pitch", "axis3.pitch", "axis3.x", "axis5.pitch"), robust=False, covariance="stated")
REAL = Term("wave", "axis2", "pitch", "a*sin(3*q2)", {"a": 0.0})
IDLE = Term("idle", "axis3", "pitch", "b*cos(5*q4)", {"b": 0.0})
BOTH = ("wave.a", "idle.b")
MODEL = kr_like().with_terms((REAL, IDLE))


@pytest.fixture(scope="module")
def watched() -> tuple[IdentifiedInstruments, JointLog, list]:
    """A robot with one of two terms, watched by a tracker and a wire."""
    s = scenario(4, compliant=False, n=40, scale=0.0)
    true = replace(s.model, terms=(replace(REAL, parameters={"a": 4e-4}),))
    kernel = Kernel(true).with_references(s.truth.world_T_base, s.truth.flange_T_tool)
    s = replace(s, truth=kernel, theta=kernel.theta0, poses=_log(s).inputs(kernel))
    rng = np.random.default_rng(5)
    log = _log(replace(s, model=s.model))
    instruments = [_instrument("tracker", _frames(s, rng)), _instrument("wire", _lengths(s, rng))]
    return identify_instruments(MODEL, log, instruments, OPTIONS), log, instruments


def test_a_term_that_is_there_pays_and_one_that_is_not_waits(watched) -> None:  # type: ignore[no-untyped-def]
    found, log, _ = watched
    folds = InstrumentFolds(MODEL, found, log, OPTIONS)
    decided = choose_among(folds, BOTH)
    assert decided.diagnosed
    assert "wave.a" in decided.form.free
    assert "idle.b" not in decided.form.free
    assert "error over blocked folds" in decided.waits["idle.b"]
    assert decided.diagnosed_error < 0.5 * decided.identified
    assert contradicted_groups(folds, {"real": ("wave.a",)}) == []


def test_errors_over_folds_are_those_of_robots_identified_without_them(watched) -> None:  # type: ignore[no-untyped-def]
    found, log, instruments = watched
    folds = InstrumentFolds(MODEL, found, log, OPTIONS)
    form = Form(found.placed["tracker"].robot.model, found.names)
    plain, _ = folds.delivery(form, log).errors(("wave.a",))
    fold = int(folds.labels[0])
    out = np.zeros(len(log), dtype=bool)
    out[folds._fitted.pose[folds.labels == fold]] = True
    nominal = found.placed["tracker"].robot.nominal
    model = replace(nominal.nominal(), terms=(IDLE,), world_T_base=None, flange_T_tool=None)
    again = identify_instruments(model, replace(log, verify=out), instruments, OPTIONS)
    for number, name in enumerate(("tracker", "wire")):
        placed = again.placed[name]
        T = placed.robot.predict(placed.robot.inputs(log))[0]
        o = placed.recording.observations[0]
        missed = (
            o.distance - np.linalg.norm(T[:, :3, 3], axis=1) if number else (tf.invert(T) @ o.world_T_tool)[:, :3, 3]
        )
        rows = np.flatnonzero(out)
        expected = np.abs(missed[rows]) if number else np.linalg.norm(missed[rows], axis=1)
        assert np.allclose(plain[number * len(log) + rows], expected, rtol=0.02, atol=2e-6)

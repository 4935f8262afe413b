"""Drift control against a robot whose distributed temperatures no parameter describes."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.drift.control import ControlState, DriftControl, started
from robcal.drift.fit import fit_drift
from robcal.drift.jumps import CRASH, smallest_jumps, unwatched_joints
from robcal.drift.reference import DriftReference, freeze
from robcal.errors import InvalidInput
from tests.drift.scenes import SIGMA, Scene, make_scene

pytestmark = pytest.mark.unit


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


@pytest.fixture(scope="module")
def reference(scene: Scene) -> DriftReference:
    return freeze(scene.robot, scene.readings(0))


def control_at(scene: Scene, reference: DriftReference, cycle: int) -> DriftControl:
    """A control that has followed the robot up to a cycle."""
    control = DriftControl(reference, started(reference, scene.readings(0)))
    for k in range(1, cycle + 1):
        tour = scene.readings(k)
        assert not control.take(tour, range(len(tour))).alarms
    return control


@pytest.fixture(scope="module")
def warm_state(scene: Scene, reference: DriftReference) -> ControlState:
    return control_at(scene, reference, 12).state


def test_follows_the_robot_while_it_warms_up(scene: Scene, reference: DriftReference) -> None:
    control = DriftControl(reference, started(reference, scene.readings(0)))
    corrected, uncorrected = [], []
    for k in range(1, 60):
        tour = scene.readings(k)
        events = control.take(tour, range(len(tour)))
        assert not events.alarms
        assert set(events.uses.values()) == {"used"}
        corrected.append(events.tours[0].corrected)
        uncorrected.append(events.tours[0].uncorrected)
    assert uncorrected[-1] > 4e-4
    assert np.mean(corrected) < 4e-5 < np.mean(uncorrected)


def test_covariance_covers_the_change_of_parameters_that_drift(scene: Scene, reference: DriftReference) -> None:
    """Parameters drawn from their expected changes, readings with their noise: normalised errors are chi-squared."""
    rng = np.random.default_rng(5)
    inputs = scene.readings(0)
    slots = np.arange(len(inputs))
    exact = replace(reference, covariance=np.zeros_like(reference.covariance))
    squares = []
    for _ in range(200):
        truth = reference.sizes * rng.standard_normal(len(reference.sizes))
        T = exact.kernel.frames(exact.theta(truth), inputs.inputs)
        x = np.einsum("nji,nj->ni", T[:, :3, :3], exact.p - T[:, :3, 3]) + SIGMA * rng.standard_normal((len(T), 3))
        now = replace(inputs, x=x, time=np.zeros(len(x)))
        fit = fit_drift(exact, now, slots, np.zeros(len(truth)))
        error = fit.change - truth
        squares.append(error @ np.linalg.solve(fit.covariance, error))
    assert np.mean(squares) == pytest.approx(len(reference.sizes), rel=0.06)


def test_commands_that_are_compensated_give_the_same_model(scene: Scene, reference: DriftReference) -> None:
    q = scene.q + np.random.default_rng(2).normal(0, 3e-4, scene.q.shape)
    changes = []
    for commanded in (None, q):
        tour = replace(scene.readings(40, q=commanded))
        changes.append(fit_drift(reference, tour, np.arange(len(tour)), np.zeros(len(reference.names))))
    difference = changes[1].linear.A @ (changes[1].change - changes[0].change)
    assert np.linalg.norm(difference, axis=1).mean() < 1e-5
    assert np.linalg.norm(changes[1].residual, axis=1).mean() < 3e-5


def test_a_tour_in_parts_waits_for_its_last_reading(scene: Scene, reference: DriftReference) -> None:
    control = DriftControl(reference, started(reference, scene.readings(0)))
    parts = np.array_split(np.arange(len(scene.q)), 4)
    for k, rows in enumerate(parts, start=1):
        events = control.take(scene.readings(k, rows=rows.tolist(), hour=0.1), rows.tolist())
        assert len(events.tours) == (k == 4)
    assert set(events.uses.values()) == {"used"}


@pytest.mark.parametrize(
    ("what", "trouble"),
    [
        ("body", {"push": (0.0003, 0.0, 0.0)}),
        ("axis2", {"slip": (0, np.radians(0.02), 0, 0, 0, 0)}),
        ("axis4", {"slip": (0, 0, 0, np.radians(0.02), 0, 0)}),
    ],
)
def test_a_jump_is_an_alarm_and_not_compensated(
    scene: Scene, reference: DriftReference, warm_state: ControlState, what: str, trouble: dict[str, tuple[float, ...]]
) -> None:
    control = DriftControl(reference, warm_state)
    tour = scene.readings(13, **trouble)
    events = control.take(tour, range(len(tour)))
    assert [a.kind for a in events.alarms] == ["jump"]
    assert ("targets moved" if what == "body" else what) in events.alarms[0].text
    assert control.state.model == warm_state.model
    for k in range(14, 30):  # it lasts, and is told once
        tour = scene.readings(k, **trouble)
        assert not control.take(tour, range(len(tour))).alarms
    assert control.state.model == warm_state.model


def test_a_dirty_target_is_left_out_and_told_once(
    scene: Scene, reference: DriftReference, warm_state: ControlState
) -> None:
    control = DriftControl(reference, warm_state)
    target = int(scene.target[3])
    kinds = []
    for k in (13, 14):
        tour = scene.readings(k, dirt=(target, (0.0, 0.0002, 0.0)))
        events = control.take(tour, range(len(tour)))
        kinds += [(a.kind, f"target {target + 1} " in a.text) for a in events.alarms]
        rejected = {i for i, use in events.uses.items() if use == "rejected"}
        assert rejected == set(np.flatnonzero(scene.target == target).tolist())
        assert events.tours[0].accepted
    assert kinds == [("target", True)]


def test_standstill_begins_a_tour_anew_and_wants_it_whole(
    scene: Scene, reference: DriftReference, warm_state: ControlState
) -> None:
    control = DriftControl(reference, warm_state)
    half = list(range(12))
    control.take(scene.readings(13, rows=half), half)
    later = warm_state.newest_time + 4 * 3600.0
    first = control.take(scene.readings(14, rows=half, hour=0.0, time_s=later), [100 + i for i in half])
    assert [first.uses[i] for i in half] == ["expired"] * 12
    second = control.take(scene.readings(15, rows=[12], hour=0.0, time_s=later + 300), [200])
    assert [a.kind for a in second.alarms] == ["stale"]


def test_clock_that_runs_back_and_files_out_of_order(
    scene: Scene, reference: DriftReference, warm_state: ControlState
) -> None:
    control = DriftControl(reference, warm_state)
    back = control.take(scene.readings(13, rows=[0], time_s=100.0), [0])
    assert [a.kind for a in back.alarms] == ["clock"]
    control = DriftControl(reference, warm_state)
    late = control.take(scene.readings(9), range(len(scene.q)))
    assert set(late.uses.values()) == {"late"}
    assert not late.alarms
    assert control.state.model == warm_state.model


def test_bounds_hold_a_parameter(scene: Scene, reference: DriftReference, warm_state: ControlState) -> None:
    tight = replace(reference, settings=replace(reference.settings, bounds=0.05))
    control = DriftControl(tight, warm_state)
    tour = scene.readings(13)
    events = control.take(tour, range(len(tour)))
    assert "bound" in {a.kind for a in events.alarms}
    assert np.all(np.abs(control.state.model.change) <= 0.05 * tight.sizes * (1 + 1e-9))


def test_bad_references_are_refused(scene: Scene) -> None:
    with pytest.raises(InvalidInput, match="at least six"):
        freeze(scene.robot, scene.readings(0, rows=[0, 1, 2]))
    with pytest.raises(InvalidInput, match=r"no parameter 'axis9.x'"):
        freeze(scene.robot, scene.readings(0), parameters=["axis9.x"])


def test_a_joint_that_the_tour_hardly_moves_is_named(scene: Scene, reference: DriftReference) -> None:
    smallest = smallest_jumps(reference)
    named = {sentence.split(" ", 1)[0] for sentence in unwatched_joints(reference)}
    assert named == {name for name, size in smallest.items() if size > CRASH}
    # a sensor whose targets lie on the axis of the last joint does not see it turn
    kernel = reference.kernel.with_references(None, np.eye(4))
    poses = kernel.poses(reference.q)
    flange = kernel.frames(kernel.theta0, poses)
    along = kernel.joint_jacobian(kernel.theta0, poses)[:, 3:, 5]
    on_axis = flange[:, :3, 3] + 0.3 * np.einsum("nij,nj->ni", flange[:, :3, :3], along)
    blind = replace(reference, p=on_axis)
    assert smallest_jumps(blind)["axis6"] > 20.0 * smallest_jumps(blind)["axis1"]
    assert any(sentence.startswith("axis6 cannot be watched by this tour") for sentence in unwatched_joints(blind))

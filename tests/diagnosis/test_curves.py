"""Irregular error curves of joints: found, alike where they are, and not taken for what has a name."""

import numpy as np
import pytest

from robcal import transforms as tf
from robcal.calibration.identification import identify
from robcal.calibration.observations import FrameObservations
from robcal.diagnosis.core.fitting import Accepted, Fit, fit, terms_of
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.diagnose import diagnose
from robcal.diagnosis.search.curves import LEAST_POSES, find_curves, frozen_terms, nested_errors
from robcal.diagnosis.search.folded_normals import Folded
from robcal.diagnosis.search.likeness import likenesses
from robcal.physics.angle_error_curve import periodic_curve
from robcal.physics.site import Joint
from robcal.robot.kernel import Kernel
from robcal.robot.terms import evaluate
from tests.calibration.scenarios import Scenario, scenario

ORDERS = np.arange(3, 25)


def pattern(seed: int, angle: np.ndarray, size: float = 3e-4) -> np.ndarray:
    """An irregular curve with period one turn and an RMS of `size`."""
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, len(ORDERS)))
    y = np.cos(np.outer(angle, ORDERS)) @ a + np.sin(np.outer(angle, ORDERS)) @ b
    return np.asarray(size * y / np.sqrt(len(ORDERS)))


def recorded(wrong_q: np.ndarray, s: Scenario, sigma: float = 3e-5) -> tuple[Recording, FrameObservations]:
    obs = s.frames(s.poses.with_q(wrong_q), sigma, 2 * sigma)
    n = len(wrong_q)
    covariates = {"index": np.arange(n, dtype=float)}
    names = tuple(f"p{i}" for i in range(n))
    return Recording(s.poses.q, ("dumbbell",) * n, covariates, names, obs), obs


def fitted(recording: Recording, obs: FrameObservations, s: Scenario) -> Fit:
    found = identify(s.model, s.poses, [obs], kernel=s.kernel)
    return fit(found.model, recording, found.names)


@pytest.fixture(scope="module")
def uneven() -> tuple[Recording, Fit, np.ndarray]:
    """Every joint has the same uneven pitch, turned; the third is mounted the other way round."""
    s = scenario(3, n=400)
    q = s.poses.q
    added = np.stack([pattern(1, q[:, k] + 0.7 * k) for k in range(q.shape[1])], axis=1)
    added[:, 2] = -pattern(1, -q[:, 2] + 1.0)
    recording, obs = recorded(q + added, s)
    return recording, fitted(recording, obs, s), added


def test_curves_of_all_joints_are_found(uneven: tuple[Recording, Fit, np.ndarray]) -> None:
    recording, present, added = uneven
    found = find_curves(present, recording)
    assert [item.cause.where for item in found.accepted] == ["all joints", *(f"axis{k}" for k in range(1, 7))]
    assert found.p_value < 1e-100
    errors = nested_errors(present, recording, found.accepted, None)
    assert len(errors) == 8
    assert errors[-1] < 0.4 * errors[0]
    told = found.accepted[0].cause.report(found.accepted[0].values, found.accepted[0].constants)
    assert told["sense"] == {f"axis{k}": -1 if k == 3 else 1 for k in range(1, 7)}
    turns = np.array(list(told["shift_deg"].values()))  # type: ignore[attr-defined]
    assert turns == pytest.approx(np.degrees([0.0, 0.7, 1.0, 2.1, 2.8, 3.5]), abs=1.0)
    for k in range(6):
        q = recording.q[:, k]
        slow = np.vander(q, 5)  # zero offsets and slow waves are also geometry
        both = of_joint(found.accepted, k + 1, q)
        truth, reported = (y - slow @ np.linalg.lstsq(slow, y, rcond=None)[0] for y in (added[:, k], both))
        assert np.corrcoef(truth, reported)[0, 1] > 0.9


@pytest.mark.slow
def test_a_curve_is_shared_by_those_joints_alone_that_have_it() -> None:
    s = scenario(5, n=400)
    q = s.poses.q
    added = np.stack([pattern(1 if k < 3 else k, q[:, k] + 0.7 * k) for k in range(6)], axis=1)
    recording, obs = recorded(q + added, s)
    shared, *own = find_curves(fitted(recording, obs, s), recording).accepted
    assert shared.cause.where == "axis1, axis2, axis3"
    assert len(own) == 6


def test_blocks_weigh_by_what_the_others_tell_of_them() -> None:
    rng = np.random.default_rng(0)
    X = np.column_stack([rng.normal(size=(60, 2)), 0.5 * rng.normal(size=(60, 3))])
    label = np.repeat(np.arange(4), 15)
    X[label != 3, 4] = 0.0  # the last block alone shows the last column
    r = X @ np.array([1.0, -2.0, 1.5, -0.5, 3.0]) + rng.normal(size=60)
    blocks = [(A.T @ A, A.T @ b, float(b @ b), len(b)) for k in range(4) for A, b in [(X[label == k], r[label == k])]]
    variance = 1.3
    found = Folded(tuple(blocks), np.array([2, 5]), variance).deviance([0])
    ridge = np.concatenate([np.full(2, 1e-9 * np.max(np.diag(X.T @ X))), np.full(3, variance)])
    for k in range(4):
        A, b, test = X[label != k], r[label != k], X[label == k]
        C = np.linalg.inv(A.T @ A + np.diag(ridge))
        S = variance * (np.eye(15) + test @ C @ test.T)
        left = r[label == k] - test @ (C @ (A.T @ b))
        assert found[k] == pytest.approx(left @ np.linalg.solve(S, left) + np.linalg.slogdet(S)[1])


def of_joint(accepted: tuple[Accepted, ...], number: int, q: np.ndarray) -> np.ndarray:
    """What all curves together add to the angle of a joint."""
    total = np.zeros(len(q))
    for item in accepted:
        value = dict(zip(item.names, item.values, strict=True))
        laws = [b for b in item.cause.laws(item.constants) if b.frame == f"axis{number}"]
        total = total + sum(value[b.parameter] * b.value({f"q{number}": q}) for b in laws)
    return total


def test_a_shared_curve_held_as_numbers_is_the_same_robot(uneven: tuple[Recording, Fit, np.ndarray]) -> None:
    recording, present, _ = uneven
    item = find_curves(present, recording).accepted[0]
    inputs = {f"q{k + 1}": recording.q[:, k] for k in range(6)}
    for number in range(1, 7):
        held = [t for t in frozen_terms(item) if t.frame == f"axis{number}"]
        value = np.sum([evaluate(t.expression, inputs) for t in held], axis=0)
        assert value == pytest.approx(of_joint((item,), number, recording.q[:, number - 1]))


def test_likeness_tells_turn_and_sense() -> None:
    q = np.linspace(-np.pi, np.pi, 500)
    items = []
    for k, law in ((1, pattern(5, q)), (2, pattern(5, q + 1.0)), (3, -pattern(5, -q + 2.0)), (4, pattern(6, q))):
        cause = periodic_curve(Joint(k, f"axis{k}", "z", 1, False), q, 72)
        laws = np.stack([b.value({f"q{k}": q}) for b in cause.bases(cause.grid[0])], axis=1)  # type: ignore[misc]
        values = np.linalg.lstsq(laws, law, rcond=1e-8)[0]
        items.append(Accepted(cause, cause.grid[0], values, np.zeros((72, 72))))
    found = {like.joint: like for like in likenesses(items, [q] * 4)}
    assert set(found) == {"axis2", "axis3"}
    assert (found["axis2"].other, found["axis2"].sense) == ("axis1", 1)
    assert found["axis2"].shift == pytest.approx(1.0, abs=0.02)
    assert found["axis3"].sense == -1
    by = {"axis1": 2.0, "axis2": 1.0}[found["axis3"].other]
    assert found["axis3"].shift == pytest.approx(by, abs=0.02)


def test_nothing_and_what_has_a_name_are_left_alone() -> None:
    s = scenario(4, n=200)
    q = s.poses.q
    recording, obs = recorded(q, s)
    assert not find_curves(fitted(recording, obs, s), recording).accepted
    wave = q.copy()
    wave[:, 1] += 4e-4 * np.cos(17 * q[:, 1])
    recording, obs = recorded(wave, s)
    assert not find_curves(fitted(recording, obs, s), recording).accepted


def test_few_poses_tell_no_curves(uneven: tuple[Recording, Fit, np.ndarray]) -> None:
    recording, present, _ = uneven
    short = recording.subset(np.arange(len(recording.q)) < LEAST_POSES - 1)
    assert not find_curves(present, short).accepted


def test_long_laws_become_several_terms_with_priors() -> None:
    q = np.linspace(-3, 3, 100)
    cause = periodic_curve(Joint(2, "axis2", "z", 1, False), q, 72)
    count = len(cause.names(cause.grid[0]))
    terms = terms_of(Accepted(cause, cause.grid[0], np.arange(count) * 1e-5, np.zeros((count, count))), 0)
    assert len(terms) == 3
    assert sum(len(t.priors) for t in terms) == count
    assert [v for t in terms for v in t.parameters.values()] == pytest.approx(np.arange(count) * 1e-5)


@pytest.mark.slow
def test_diagnosis_models_the_curves(uneven: tuple[Recording, Fit, np.ndarray]) -> None:
    recording, present, added = uneven
    reported = diagnose(present.model, recording, present.free)
    curves = [f for f in reported.findings if "period_deg" in f.parameters]
    assert [f.cause.where for f in curves] == ["all joints", *(f"axis{k}" for k in range(1, 7))]
    assert reported.heldout[1] < 0.4 * reported.heldout[0]
    assert reported.joint_sigma < 0.5 * np.std(added)
    assert "turned by" in " ".join(f.statement for f in curves)


@pytest.mark.slow
def test_predicted_covariance_holds_at_poses_kept_out(uneven: tuple[Recording, Fit, np.ndarray]) -> None:
    """Joints that scatter and curves that are known only where the joints were: errors have the reported size."""
    s = scenario(3, n=400)

    def wrong(q: np.ndarray) -> np.ndarray:
        added = np.stack([pattern(k, q[:, k]) for k in range(6)], axis=1)
        return np.asarray(q + added + 1e-4 * s.rng.normal(size=q.shape))

    recording, obs = recorded(wrong(s.poses.q), s)
    found = identify(s.model, s.poses, [obs], kernel=s.kernel)
    reported = diagnose(found.model, recording, found.names)
    assert [f.cause.where for f in reported.findings][:6] == [f"axis{k}" for k in range(1, 7)]
    assert reported.joint_sigma == pytest.approx(1e-4, rel=0.4)
    true = s.truth.frames(s.theta, s.kept_out.with_q(wrong(s.kept_out.q)))
    kernel = Kernel(reported.model, "converged")
    inputs = kernel.poses(s.kept_out.q, "dumbbell", {"index": np.arange(len(s.kept_out), dtype=float)})
    T, J = kernel.frames_and_jacobian(kernel.theta0, inputs, np.array([kernel.index[n] for n in reported.free]))
    moved = reported.joint_sigma * kernel.joint_jacobian(kernel.theta0, inputs)
    error = (tf.invert(T) @ true)[:, :3, 3]
    parameters = (J @ reported.covariance @ J.swapaxes(1, 2))[:, :3, :3]
    whole = parameters + (moved @ moved.swapaxes(1, 2))[:, :3, :3]

    def normalised(V: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(V), error)) / 3.0))

    assert 0.8 < normalised(whole) < 1.3
    assert normalised(parameters) > 1.5

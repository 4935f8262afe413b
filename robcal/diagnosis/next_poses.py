"""Poses, payloads and approach directions that would tell rival causes apart."""

from collections.abc import Mapping

import numpy as np

from robcal.diagnosis.core.fitting import Fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.core.result import Finding
from robcal.physics.cause import Array, Constants, LinearCause, ObservationCause
from robcal.robot.kernel import PoseInputs
from robcal.robot.model import RobotModel

COUNT = 15
CANDIDATES = 400
TYPICAL_SIGMA = (5e-5, 1e-4)
"""Metres and radians: what one more measured frame is assumed to be worth."""


def separating_poses(
    fitted: Fit, recording: Recording, finding: Finding, *, count: int = COUNT, seed: int = 0
) -> tuple[dict[str, float], ...]:
    """Poses at which the named cause and its rivals differ most, the weakest rival first (greedy).

    Each pose maps `qK` (rad or m), `approachK` and `payload` (number of the payload in the model, -1 for none).
    The score of a candidate is the part of the named effect that the rival and all fitted parameters, adjusted to
    everything measured and chosen so far, fail to reproduce there: the growth of the rival's non-centrality.
    Weakness: collisions and visibility are not checked here; the pose generator can be given these poses to check.
    """
    rivals = [r for r in finding.rivals if not isinstance(r.cause, ObservationCause)]
    if not rivals or isinstance(finding.cause, ObservationCause):
        return ()
    inputs = _candidates(fitted, recording, CANDIDATES, seed)
    here, there = _frame_columns(fitted, fitted.inputs), _frame_columns(fitted, inputs)
    free = [i for i, name in enumerate(fitted.kernel.names) if name in fitted.free]
    own_here = here.effect(finding.cause, finding.constants) @ finding.values
    own_there = there.effect(finding.cause, finding.constants) @ finding.values
    base_here, base_there = here.parameters[:, :, free], there.parameters[:, :, free]
    per_rival = [
        (
            np.concatenate([base_here, here.effect(r.cause, r.constants)], axis=2),
            np.concatenate([base_there, there.effect(r.cause, r.constants)], axis=2),
        )
        for r in rivals
    ]
    normals = [np.tensordot(a, a, axes=((0, 1), (0, 1))) for a, _ in per_rival]
    rights = [np.tensordot(a, own_here, axes=((0, 1), (0, 1))) for a, _ in per_rival]
    reached = np.zeros(len(rivals))
    taken: list[int] = []
    for _ in range(min(count, len(inputs))):
        weakest = int(np.argmin(reached))
        columns = per_rival[weakest][1]
        normal = normals[weakest]
        ridge = 1e-12 * np.diag(np.diag(normal)) + 1e-18 * np.eye(len(normal))
        inverse = np.linalg.pinv(normal + ridge, rcond=1e-14, hermitian=True)
        residual = own_there - columns @ (inverse @ rights[weakest])
        leverage = (columns @ inverse) @ columns.swapaxes(1, 2) + np.eye(6)
        score = np.einsum("nk,nk->n", residual, np.linalg.solve(leverage, residual[:, :, None])[:, :, 0])
        score[taken] = -1.0
        best = int(np.argmax(score))
        taken.append(best)
        for i, (_, other) in enumerate(per_rival):
            normals[i] = normals[i] + other[best].T @ other[best]
            rights[i] = rights[i] + other[best].T @ own_there[best]
        reached[weakest] += score[best]
    return tuple(row_of(inputs, fitted.model, i) for i in taken)


class _frame_columns:
    """Columns (n, 6, c) of effects and parameters on the tool frame, in units of a typical frame's sigma."""

    def __init__(self, fitted: Fit, inputs: PoseInputs) -> None:
        kernel = fitted.kernel
        weight = 1.0 / np.repeat(TYPICAL_SIGMA, 3)[None, :, None]
        basis = kernel.scan_basis(fitted.theta, inputs)
        self._motion = {name: basis.J[:, :, i] * weight[:, :, 0] for i, name in enumerate(basis.names)}
        self._variables = kernel.variables(fitted.theta, inputs)
        self.parameters = kernel.frames_and_jacobian(fitted.theta, inputs)[1] * weight
        self._index = kernel.index

    def effect(self, cause: LinearCause, constants: Constants) -> Array:
        """Columns of one cause."""
        if cause.free_parameters:
            return self.parameters[:, :, [self._index[name] for name in cause.free_parameters]]
        names = cause.names(constants)
        out = np.zeros((*self.parameters.shape[:2], len(names)))
        for basis in cause.laws(constants):
            law = np.broadcast_to(basis.value(self._variables), self._variables["index"].shape)
            out[:, :, names.index(basis.parameter)] += self._motion[f"{basis.frame}.{basis.kind}"] * law[:, None]
        return out


def _candidates(fitted: Fit, recording: Recording, count: int, seed: int) -> PoseInputs:
    rng = np.random.default_rng(seed)
    model = fitted.model
    low, high = recording.q.min(axis=0), recording.q.max(axis=0)
    for k, joint in enumerate(model.joints):
        if joint.limits is not None:
            low[k], high[k] = joint.limits
    q = rng.uniform(low, high, size=(count, model.n_joints))
    loads = [None, *model.payloads] if not recording.payload or None in recording.payload else list(model.payloads)
    payload = [loads[i] for i in rng.integers(len(loads), size=count)]
    last = int(np.argmax(recording.covariates["index"]))
    covariates: dict[str, Array] = {
        name: np.full(count, float(values[last])) for name, values in recording.covariates.items()
    }
    covariates["index"] = covariates["index"] + 1.0 + np.arange(count)
    for k in range(model.n_joints):
        covariates[f"approach{k + 1}"] = rng.choice([-1.0, 1.0], size=count)
    return fitted.kernel.poses(q, payload=payload, covariates=covariates)


def row_of(inputs: PoseInputs, model: RobotModel, i: int) -> dict[str, float]:
    """Pose i to be driven: `qK` (rad or m), `approachK`, `payload` (its number in the model, -1 for none)."""
    row: dict[str, float] = {f"q{k + 1}": float(value) for k, value in enumerate(inputs.q[i])}
    row.update({name: float(v[i]) for name, v in inputs.covariates.items() if name.startswith("approach")})
    row["payload"] = float(np.argmax(inputs.load[i])) if np.any(inputs.load[i]) else -1.0
    return row


def poses_table(poses: tuple[Mapping[str, float], ...], model: RobotModel) -> list[dict[str, object]]:
    """Rows of a poses.csv: degrees or millimetres, approach directions, names of payloads."""
    names = list(model.payloads)
    rows: list[dict[str, object]] = []
    for number, pose in enumerate(poses, 1):
        row: dict[str, object] = {"pose": f"next{number:02d}"}
        for k, joint in enumerate(model.joints, 1):
            value = pose[f"q{k}"]
            row[f"q{k}_mm" if joint.prismatic else f"q{k}_deg"] = round(
                value * 1e3 if joint.prismatic else float(np.degrees(value)), 4
            )
        row.update({name: int(value) for name, value in pose.items() if name.startswith("approach")})
        if names:
            row["payload"] = names[int(pose["payload"])] if pose["payload"] >= 0 else ""
        rows.append(row)
    return rows

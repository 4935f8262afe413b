"""Identification from measurements that state no uncertainty, or a wrong one: variance components.

Each group's sum of squares is set against its share of the redundancy (Foerstner 1979).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from robcal.calibration.identification import IdentifiedRobot, IdentifyOptions, identify
from robcal.calibration.measurements import RobotObservations, RobotRecording, Rows, rescaled
from robcal.calibration.noise_parts import LARGE, length_scatter, stated_square
from robcal.calibration.observations import FrameObservations, PointObservations
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import RobotModel
from robcal.transforms import Array

WRONG = 3.0
"""Factor from which lengths on the body refute a stated sigma that is too small."""
LEVEL = 1e-4
APART = 10.0
"""Factor from which residuals of positions and rotations refute what is stated of them."""
FEWEST = 50
"""Redundancy from which residuals refute a stated sigma."""


def identify_recording(
    robot: RobotModel,
    inputs: PoseInputs,
    recording: RobotRecording,
    rows: Rows,
    options: IdentifyOptions,
    kernel: Kernel,
) -> tuple[IdentifiedRobot, RobotRecording]:
    """Identify; again with variance components where no uncertainty is stated, or one that residuals contradict."""
    subset = inputs.subset(rows)
    found = identify(robot, subset, recording.select(rows), options, kernel)
    if recording.stated:
        weighted = believable(found, subset, recording, rows)
        if weighted is recording:
            return found, recording
        return identify(robot, subset, weighted.select(rows), options, kernel), weighted
    for _ in range(2):
        factors = variance_factors(found, subset, recording.select(rows), recording.observations)
        observations = rescaled(recording.observations, factors)
        # points tell by their body how they scatter; what they carry, frames, follows the robot's residuals
        pairs = zip(recording.detailed, recording.observations, observations, strict=True)
        detailed = tuple(new if own is old else own for own, old, new in pairs)
        recording = replace(recording, observations=observations, detailed=detailed)
        found = identify(robot, subset, recording.select(rows), options, kernel)
    return found, recording


def believable(found: IdentifiedRobot, inputs: PoseInputs, recording: RobotRecording, rows: Rows) -> RobotRecording:
    """The recording itself, or with other weights where its stated sigmas are contradicted beyond what models miss.

    Residuals hold the noise and what the model misses: they refute a stated sigma only from above, or where positions
    and rotations disagree by far more than what is missed can. Lengths on the body refute it from below.
    """
    used = recording.select(rows)
    residual = variance_factors(found, inputs, used, recording.observations)
    seen = [any(type(o) is type(kind) for o in used) for kind in recording.observations]
    lengths = _from_lengths(recording.select(rows, detailed=True))
    factors = [
        _refuted(factor, found.redundancy, lengths) if known and found.redundancy >= FEWEST else np.ones(len(factor))
        for factor, known in zip(residual, seen, strict=True)
    ]
    if all(np.all(factor == 1.0) for factor in factors):
        return recording
    observations = rescaled(recording.observations, factors)
    points = [factor[:1] for factor in factors]
    detailed = tuple(
        new if own is old else rescaled([own], [factor])[0]
        for own, old, new, factor in zip(recording.detailed, recording.observations, observations, points, strict=True)
    )
    message = " and ".join(f"{np.sqrt(f):.2g}" for f in dict.fromkeys(float(v) for factor in factors for v in factor))
    note = f"the stated uncertainties are contradicted: the weights have {message} times the stated sigmas"
    return replace(
        recording,
        observations=observations,
        detailed=detailed,
        weighted=float(np.sqrt(factors[0][0])),
        notes=(*recording.notes, note),
    )


def _refuted(residual: Array, redundancy: int, lengths: float | None) -> Array:
    """Factors on the variances of one kind: ones where what is stated may be."""
    if len(residual) > 1 and not APART**-2 < residual[0] / residual[1] < APART**2:
        return residual
    # residuals below what is stated cannot be noise of that size, whatever else they hold
    if np.all(residual < LARGE**2) and stats.chi2.cdf(float(np.mean(residual)) * redundancy, redundancy) < LEVEL:
        return residual
    if lengths is not None and lengths > WRONG**2:
        return np.full(len(residual), lengths)
    return np.ones(len(residual))


def _from_lengths(observations: Sequence[RobotObservations]) -> float | None:
    """Factor on the stated variance of points that lengths between them show; None where there are none."""
    points = [o for o in observations if isinstance(o, PointObservations)]
    scatter = length_scatter(points)
    return None if scatter is None else scatter**2 / stated_square(points)


def variance_factors(
    found: IdentifiedRobot, inputs: PoseInputs, used: Sequence[RobotObservations], kinds: Sequence[RobotObservations]
) -> list[Array]:
    """Factor by which the variances of each kind are too small: (2,) position and rotation of frames, else (1,).

    Every group's sum of squares is set against its share of the redundancy, which is taken as even.
    """
    T = found.kernel.frames(found.kernel.theta0, inputs)
    share = found.redundancy / max(found.redundancy + len(found.names), 1)
    factors: list[Array] = []
    remaining = list(used)
    for kind in kinds:
        mine = next((o for o in remaining if type(o) is type(kind)), None)
        if mine is None:
            factors.append(np.ones(2 if isinstance(kind, FrameObservations) else 1))
            continue
        remaining.remove(mine)
        keep = found.used[mine.pose]
        r, _ = mine.evaluate(T)
        white = np.linalg.solve(np.linalg.cholesky(mine.noise(T)), r[..., None])[..., 0][keep]
        groups = [white[:, :3], white[:, 3:]] if isinstance(kind, FrameObservations) else [white]
        factors.append(np.array([max(float(np.mean(g**2)) / max(share, 0.05), 1e-12) for g in groups]))
    return factors

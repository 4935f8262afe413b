"""Errors of many joints over their own angle, found together: encoders and gears whose error repeats every turn.

A scan that adds one cause at a time drowns where every joint of a robot has an irregular error curve: each cause is
looked for in the structure that the other joints leave. Here all joints get a curve of bumps on the circle at once, a
Gaussian process with period one turn, and the poses of whole blocks that were kept out decide whether the curves are
true. A curve that a few waves describe as well is left to the causes with a name.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robcal.diagnosis.core.fitting import Accepted, Fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.gain.heldout import folds, rms
from robcal.diagnosis.scan.statistics import log_f_probability
from robcal.diagnosis.scan.tangents import Tangents, tangents
from robcal.diagnosis.search.folded_normals import Folded, Normals, amplitudes, folded, scaled, variance_with
from robcal.diagnosis.search.likeness import Likeness, irregularity, likenesses, pattern
from robcal.diagnosis.search.shared_trial import CurvesOnTrial, accepted_with, with_shared
from robcal.physics.angle_error_curve import periodic_curve
from robcal.physics.cause import Array, RobotCause
from robcal.physics.site import Joint, RobotSite
from robcal.robot.model import Term

LEAST_POSES = 150
"""Fewer poses cannot tell curves of all joints from anything else."""
BUMPS_A_TURN = (24, 36, 48, 72)
"""Numbers of bumps a turn that are tried; the kept-out poses choose."""
ROWS_A_BUMP = 4.0
"""Measured numbers that are needed for each bump."""
GAIN = 0.7
"""Share of the sum of squares at kept-out poses below which the curves must come."""
LEAST_GAIN = 0.03
"""Share of that sum of squares by which the kept-out poses must miss the curve of a joint for it to count."""
IRREGULAR = 0.35
"""Share of a curve's variance that so many waves leave: below, the curve is regular and has a name."""
HELD_PARTS = 20
"""Bumps in one expression of a curve that is held."""
SEVERAL = 2
"""With so many irregular joints all joints get a curve."""


@dataclass(frozen=True)
class Curves:
    """Error curves of joints.

    Attributes
    ----------
    accepted : one cause per joint with its amplitudes, to be fitted again with everything else; before them the curve
        that joints share, where they do.
    shares : share of the sum of squares above the noise that each explains.
    likenesses : joints whose curves are alike, where none is shared.
    p_value : of the F test of all curves together, for all scales tried.
    """

    accepted: tuple[Accepted, ...] = ()
    shares: tuple[float, ...] = ()
    likenesses: tuple[Likeness, ...] = ()
    p_value: float = 1.0

    @property
    def frozen(self) -> tuple[Term, ...]:
        """The curves as terms without parameters, for a search of what else is missing."""
        return tuple(term for item in self.accepted for term in frozen_terms(item))


def find_curves(present: Fit, recording: Recording) -> Curves:
    """Curves of all joints whose errors follow their own angle irregularly; none where that is not proved.

    Parameters
    ----------
    present : the fitted robot at the poses of the recording.

    Weakness: one scale of the bumps for all joints; an error that depends on the number of the turn is averaged.
    """
    if len(recording.q) < LEAST_POSES or not recording.observations_are_spatial:
        return Curves()
    at = tangents(present, recording)
    site = RobotSite(present.model, at.variables, frozenset(present.free), frozenset())
    joints = [j for j in site.joints if not j.prismatic and site.varies(f"q{j.number}", 0.5)]
    label = folds(recording)[present.row_pose]
    best = _best_scale(present, at, site, joints, label)
    if best is None:
        return Curves()
    keep = _proved(best, present, [site.variables[f"q{j.number}"] for j in joints])
    if not keep:
        return Curves()
    joints_kept, angles = [joints[k] for k in keep], [site.variables[f"q{joints[k].number}"] for k in keep]
    group = CurvesOnTrial(present, at, label, [best.causes[k] for k in keep], [best.columns[k] for k in keep])
    alone = accepted_with(present, group.causes, group.columns)
    alike = likenesses(alone, angles)
    chosen = with_shared(group, pattern(joints_kept, alike), joints_kept, len(joints))
    accepted, used = (alone, group.columns) if chosen is None else chosen
    bumps = sum(_visited(q, c.shape[1]) for q, c in zip(angles, group.columns, strict=True))
    shares, p_value = _significance(present, accepted, used, bumps)
    return Curves(accepted, shares, alike if chosen is None else (), p_value)


@dataclass(frozen=True)
class _Scale:
    """Curves of all joints with one number of bumps a turn: their causes, scaled columns and folds, and the sum of
    squares that they leave at kept-out poses."""

    causes: list[RobotCause]
    columns: list[Array]
    folds: Folded
    after: float


def _best_scale(present: Fit, at: Tangents, site: RobotSite, joints: Sequence[Joint], label: Array) -> _Scale | None:
    """The number of bumps that kept-out poses choose, as many as the recording allows; None if it allows none."""
    best: _Scale | None = None
    angles = [site.variables[f"q{j.number}"] for j in joints]
    for count in BUMPS_A_TURN:
        causes = [periodic_curve(j, q, count) for j, q in zip(joints, angles, strict=True)]
        columns = [at.columns(f, f.grid[0]) * f.sizes(f.grid[0]) for f in causes]
        if ROWS_A_BUMP * sum(_visited(q, count) for q in angles) > len(present.residual):
            break
        parts = folded(present, columns, label)
        after = parts.kept_out(range(len(columns)))
        if best is None or after < best.after:
            best = _Scale(causes, columns, parts, after)
    return best


def _proved(scale: _Scale, present: Fit, angles: Sequence[Array]) -> list[int]:
    """Joints (by number) that have an irregular curve; none where kept-out poses do not prove any."""
    before, everyone = scale.folds.kept_out(()), range(len(scale.columns))
    if scale.after > GAIN * before:
        return []
    without = (scale.folds.kept_out([j for j in everyone if j != k]) for k in everyone)
    matters = [square - scale.after > LEAST_GAIN * before for square in without]
    values = amplitudes(present, scale.columns)
    irregular = [
        k
        for k, cause in enumerate(scale.causes)
        if matters[k] and irregularity(cause, values[k] * cause.sizes(cause.grid[0]), angles[k]) > IRREGULAR
    ]
    # where it is the make of the joints, all have it, also those whose few angles do not show how irregular it is
    keep = irregular if len(irregular) < SEVERAL else list(everyone)
    return [] if not keep or scale.folds.kept_out(keep) > GAIN * before else keep


def _significance(
    present: Fit, accepted: Sequence[Accepted], columns: Sequence[Array], bumps: int
) -> tuple[tuple[float, ...], float]:
    """Shares of the sum of squares that the curves explain, and the p-value of all together, for all scales tried."""
    r = present.residual
    square = float(r @ r)
    parts = [c @ (item.values / item.cause.sizes(item.constants)) for c, item in zip(columns, accepted, strict=True)]
    shares = tuple(float(np.clip(part @ r / square, 0.0, 1.0)) for part in parts)
    left = r - np.sum(parts, axis=0)
    freedom = len(r) - present.jacobian.shape[1]
    log_p = log_f_probability(np.array([square - left @ left]), np.array([bumps]), np.array([square]), freedom)
    return shares, float(min(1.0, len(BUMPS_A_TURN) * np.exp(log_p[0])))


def _visited(angles: Array, bumps: int) -> int:
    """Number of bumps of a turn near which a joint was."""
    return len(np.unique(np.round(angles / (2.0 * np.pi) * bumps).astype(int) % bumps))


def frozen_terms(item: Accepted) -> tuple[Term, ...]:
    """Terms with the amplitudes as numbers."""
    value = dict(zip(item.names, item.values, strict=True))
    parts: dict[tuple[str, str], list[str]] = {}
    for b in item.cause.laws(item.constants):
        parts.setdefault((b.frame, b.kind), []).append(f"{float(value[b.parameter])!r}*({b.expression})")
    return tuple(
        Term(f"{item.term(k)}_held_{frame}", frame, kind, " + ".join(texts[k : k + HELD_PARTS]))
        for (frame, kind), texts in parts.items()
        for k in range(0, len(texts), HELD_PARTS)
    )


def nested_errors(
    present: Fit, recording: Recording, accepted: Sequence[Accepted], verify: Recording | None
) -> tuple[float, ...]:
    """RMS position error (m) at kept-out poses without curves, with the first, the first two ..., to first order.

    At the poses to verify, or else at folds of the recording.
    """
    at = tangents(present, recording)
    sizes = np.concatenate([item.cause.sizes(item.constants) for item in accepted])
    X = np.column_stack([scaled(present), *(at.columns(a.cause, a.constants) for a in accepted)])
    p = len(present.free)
    X[:, p:] *= sizes
    r = present.residual
    ends = p + np.cumsum([0, *(len(a.values) for a in accepted)])
    variance = variance_with(present, X, X.T @ X, X.T @ r, p)

    def solved(rows: Array, end: int) -> Array:
        A = X[rows, :end]
        return Normals(A.T @ A, A.T @ r[rows], p).solve(variance)

    def error(of: Recording, left: Array, frames: Array) -> float:
        return rms(of.unwhiten(left[:, None], frames)[:, :3, 0])

    if verify is not None:
        there, Y = _at_other_poses(present, verify, accepted)
        Y[:, :p] /= np.where((size := np.linalg.norm(present.jacobian, axis=0)) > 0, size, 1.0)
        Y[:, p:] *= sizes
        everything = np.ones(len(r), dtype=bool)
        return tuple(error(verify, there.residual - Y[:, :end] @ solved(everything, end), there.frames) for end in ends)
    label = folds(recording)[present.row_pose]
    out = []
    for end in ends:
        left = np.empty(len(r))
        for fold in np.unique(label):
            test = label == fold
            left[test] = r[test] - X[test, :end] @ solved(~test, end)
        out.append(error(recording, left, present.frames))
    return tuple(out)


def _at_other_poses(present: Fit, recording: Recording, accepted: Sequence[Accepted]) -> tuple[Fit, Array]:
    """A fit looked at from other poses, and the columns of its parameters and of the curves there."""
    inputs = recording.inputs(present.kernel)
    columns = np.array([present.kernel.index[name] for name in present.free])
    frames, J = present.kernel.frames_and_jacobian(present.theta, inputs, columns=columns)
    residual, jacobian = recording.linearise(frames, J)
    pose = recording.observations.pose
    row_pose = np.repeat(pose, len(residual) // len(pose))
    there = replace(present, inputs=inputs, frames=frames, residual=residual, jacobian=jacobian, row_pose=row_pose)
    at = tangents(there, recording)
    return there, np.column_stack([jacobian, *(at.columns(a.cause, a.constants) for a in accepted)])

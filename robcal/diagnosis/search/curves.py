"""Errors of many joints over their own angle, found together: encoders and gears whose error repeats every turn.

A scan that adds one cause at a time drowns where every joint of a robot has an irregular error curve: each cause is
looked for in the structure that the other joints leave. Here all joints get a curve of bumps on the circle at once, a
Gaussian process with period one turn, and the poses of whole blocks that were kept out decide whether the curves are
true. A curve that a few waves describe as well is left to the causes with a name.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from robcal.diagnosis.core.fitting import Accepted, Fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.gain.heldout import folds, rms
from robcal.diagnosis.scan.statistics import log_f_probability
from robcal.diagnosis.scan.tangents import Tangents, tangents
from robcal.diagnosis.search.shared_curve import Likeness, maker, pattern, refined, seats
from robcal.physics.angle_error_curve import Placed, beside_shared, periodic_curve
from robcal.physics.cause import Array, LinearCause, RobotCause
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
WAVES = 2
HIGHEST_WAVE = 60.0
IRREGULAR = 0.35
"""Share of a curve's variance that so many waves leave: below, the curve is regular and has a name."""
BUMPS_SHARED = 72
"""Bumps a turn of a curve that joints share: all of them together show its finest waves."""
OWN_SIZES = (0.3, 0.6, 0.1)
"""Sizes, in those of a curve, of what joints that share one may differ by; the kept-out poses choose."""
HELD_PARTS = 20
"""Bumps in one expression of a curve that is held."""
LEAST_JOINING = 20.0
"""Deviance of kept-out poses by which a shared curve must predict them better: twice the logarithm of the 480 turns and
senses that are tried, and as much as decisive evidence (Kass and Raftery, 1995)."""
LEAST_SHARED = 2
"""Joints that must have a curve in common."""
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
    best: tuple[float, _Folded, list[RobotCause], list[Array]] | None = None
    for count in BUMPS_A_TURN:
        causes = [periodic_curve(j, site.variables[f"q{j.number}"], count) for j in joints]
        columns = [at.columns(f, f.grid[0]) * f.sizes(f.grid[0]) for f in causes]
        visited = sum(_visited(site.variables[f"q{j.number}"], count) for j in joints)
        if ROWS_A_BUMP * visited > len(present.residual):
            break
        folded = _folded(present, columns, label)
        after = folded.kept_out(range(len(columns)))
        if best is None or after < best[0]:
            best = after, folded, causes, columns
    if best is None:
        return Curves()
    after, folded, causes, columns = best
    before = folded.kept_out(())
    if after > GAIN * before:
        return Curves()
    everyone = range(len(columns))
    matters = [folded.kept_out([j for j in everyone if j != k]) - after > LEAST_GAIN * before for k in everyone]
    values = _solve(present, columns)
    irregular = [
        k
        for k in everyone
        if matters[k]
        and _irregularity(
            causes[k], values[k] * causes[k].sizes(causes[k].grid[0]), site.variables[f"q{joints[k].number}"]
        )
        > IRREGULAR
    ]
    # where it is the make of the joints, all have it, also those whose few angles do not show how irregular it is
    keep = irregular if len(irregular) < SEVERAL else list(everyone)
    if not keep or folded.kept_out(keep) > GAIN * before:
        return Curves()
    alone = _accepted(present, [causes[k] for k in keep], [columns[k] for k in keep])
    alike = likenesses(alone, [site.variables[f"q{joints[k].number}"] for k in keep])
    group = _Group(present, at, label, [causes[k] for k in keep], [columns[k] for k in keep])
    chosen = _with_shared(group, pattern([joints[k] for k in keep], alike), [joints[k] for k in keep], len(joints))
    accepted, used = (alone, group.columns) if chosen is None else chosen
    r = present.residual
    square = float(r @ r)
    parts = [c @ (item.values / item.cause.sizes(item.constants)) for c, item in zip(used, accepted, strict=True)]
    shares = tuple(float(np.clip(part @ r / square, 0.0, 1.0)) for part in parts)
    left = r - np.sum(parts, axis=0)
    count = sum(_visited(site.variables[f"q{joints[k].number}"], columns[k].shape[1]) for k in keep)
    log_p = log_f_probability(
        np.array([square - left @ left]), np.array([count]), np.array([square]), len(r) - present.jacobian.shape[1]
    )
    return Curves(
        accepted, shares, alike if chosen is None else (), float(min(1.0, len(BUMPS_A_TURN) * np.exp(log_p[0])))
    )


@dataclass(frozen=True)
class _Group:
    """Curves of joints on trial: where they are linearised, folds of the rows, causes and their scaled columns."""

    present: Fit
    at: Tangents
    label: Array
    causes: Sequence[RobotCause]
    columns: Sequence[Array]


def _accepted(present: Fit, causes: Sequence[RobotCause], columns: Sequence[Array]) -> tuple[Accepted, ...]:
    """Causes with the amplitudes that fit, scaled columns (m, c) each."""
    values = _solve(present, columns)
    return tuple(
        Accepted(f, f.grid[0], v * f.sizes(f.grid[0]), np.zeros((len(v), len(v))))
        for f, v in zip(causes, values, strict=True)
    )


@dataclass(frozen=True)
class _Shared:
    """A pattern with its curve on trial: deviance of each kept-out fold, size of what joints differ by."""

    deviance: Array
    size: float
    placed: tuple[Placed, ...]
    cause: RobotCause
    columns: tuple[Array, ...]

    @property
    def total(self) -> float:
        """Deviance of all folds."""
        return float(self.deviance.sum())


def _with_shared(
    group: _Group, placed: Sequence[Placed], joints: Sequence[Joint], count: int
) -> tuple[tuple[Accepted, ...], list[Array]] | None:
    """One curve for the joints of a pattern, and what each differs by, where that predicts kept-out poses better."""
    if len(placed) < LEAST_SHARED:
        return None
    make = maker(BUMPS_SHARED, group.at.variables, count)

    def solve(columns: Sequence[Array]) -> list[Array]:
        return _solve(group.present, columns)

    placed = refined(placed, make, group.at, solve, _beside(group, placed, OWN_SIZES[0]))
    found = min((_tried(group, placed, make, size) for size in OWN_SIZES), key=lambda t: t.total)
    found = _grown(group, found, joints, make, solve)
    trials = [found, *(_tried(group, found.placed, make, size) for size in OWN_SIZES[1:])]
    found = min(trials, key=lambda t: t.total)
    alone = _folded(group.present, group.columns, group.label).deviance(range(len(group.columns)))
    if not _clear(alone, found.deviance):
        return None
    members = {p.joint.where for p in found.placed}
    causes = [beside_shared(f, found.size) if f.where in members else f for f in group.causes]
    return _accepted(group.present, [found.cause, *causes], found.columns), list(found.columns)


def _clear(before: Array, after: Array) -> bool:
    """Whether deviances (folds,) fall beyond doubt, and in most folds."""
    return bool(np.sum(before - after) > LEAST_JOINING and 2 * np.sum(after < before) > len(before))


def _grown(
    group: _Group,
    found: _Shared,
    joints: Sequence[Joint],
    make: Callable[[Sequence[Placed]], RobotCause],
    solve: Callable[[Sequence[Array]], list[Array]],
) -> _Shared:
    """The pattern with the further joints in which the curve predicts kept-out poses clearly better than their own.

    Their own poses may show too little of their curve to tell that it is the same; with every joint that joins the
    curve is known better, so those that were left are tried again.
    """
    grew = True
    while grew:
        grew = False
        for joint in (j for j in joints if j.where not in {p.joint.where for p in found.placed}):
            others = [c for f, c in zip(group.causes, found.columns[1:], strict=True) if f.where != joint.where]
            tried = [
                _tried(group, (*found.placed, seat), make, found.size)
                for seat in seats(group.present, group.at, found.cause, joint, found.columns[0], others, _solve)
            ]
            best = min(tried, key=lambda t: t.total)
            if not _clear(found.deviance, best.deviance):
                continue
            turned = refined(best.placed, make, group.at, solve, _beside(group, best.placed, best.size))
            found = min(best, _tried(group, turned, make, best.size), key=lambda t: t.total)
            grew = True
    return found


def _beside(group: _Group, placed: Sequence[Placed], size: float) -> list[Array]:
    """Scaled columns of the joints' own curves, `size` times as large for those that share one."""
    members = {p.joint.where for p in placed}
    return [c * (size if f.where in members else 1.0) for f, c in zip(group.causes, group.columns, strict=True)]


def _tried(group: _Group, placed: tuple[Placed, ...], make: Callable[..., RobotCause], size: float) -> _Shared:
    """A pattern beside curves of all joints, those of its members `size` times as large."""
    own, cause = _beside(group, placed, size), make(placed)
    common = group.at.columns(cause, cause.grid[0]) * cause.sizes(cause.grid[0])
    after = _folded(group.present, [common, *own], group.label).deviance(range(len(own) + 1))
    return _Shared(after, size, placed, cause, (common, *own))


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


def curve(item: Accepted, angles: Array) -> Array:
    """Value (n,) of an accepted curve at angles (n,) of its joint, rad."""
    name = item.cause.covariates[0]
    bases = item.cause.laws(item.constants)
    return np.asarray(np.sum([v * b.value({name: angles}) for b, v in zip(bases, item.values, strict=True)], axis=0))


def nested_errors(
    present: Fit, recording: Recording, accepted: Sequence[Accepted], verify: Recording | None
) -> tuple[float, ...]:
    """RMS position error (m) at kept-out poses without curves, with the first, the first two ..., to first order.

    At the poses to verify, or else at folds of the recording.
    """
    at = tangents(present, recording)
    sizes = np.concatenate([item.cause.sizes(item.constants) for item in accepted])
    X = np.column_stack([_scaled(present), *(at.columns(a.cause, a.constants) for a in accepted)])
    p = len(present.free)
    X[:, p:] *= sizes
    r = present.residual
    ends = p + np.cumsum([0, *(len(a.values) for a in accepted)])
    variance = _variance(present, X, X.T @ X, X.T @ r, p)

    def solved(rows: Array, end: int) -> Array:
        A = X[rows, :end]
        return _Normals(A.T @ A, A.T @ r[rows], p).solve(variance)

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


@dataclass(frozen=True)
class _Normals:
    """Normal equations of the fitted parameters and of columns whose amplitudes have a unit prior."""

    gram: Array
    right: Array
    fitted: int

    def solve(self, variance: float) -> Array:
        """Parameters and amplitudes; the prior weighs as the variance factor says."""
        return np.linalg.solve(self.gram + np.diag(_ridge(self.gram, self.fitted, variance)), self.right)


def _ridge(gram: Array, fitted: int, variance: float) -> Array:
    """What is added to the diagonal of normal equations: next to nothing for fitted parameters, a unit prior else."""
    ridge = np.full(len(gram), 1e-9 * np.max(np.diag(gram)))
    ridge[fitted:] = variance
    return ridge


def _scaled(present: Fit) -> Array:
    size = np.linalg.norm(present.jacobian, axis=0)
    return present.jacobian / np.where(size > 0, size, 1.0)


@dataclass(frozen=True)
class _Folded:
    """Normal equations of each fold, and in them the places of the fitted parameters and of each joint's columns."""

    folds: tuple[tuple[Array, Array, float, int], ...]
    ends: Array
    variance: float

    def _at(self, joints: Iterable[int]) -> Array:
        fitted = np.arange(int(self.ends[0]))
        return np.concatenate([fitted, *(np.arange(self.ends[k], self.ends[k + 1]) for k in joints)])

    def deviance(self, joints: Iterable[int]) -> Array:
        """Minus twice the logarithm of the predictive density (folds,) of each fold's residuals given the others', with
        the curves of the given joints.

        Unlike their sum of squares it weighs what a block shows by how well the other blocks determine it: one that
        reaches where no other was says little of which model is right.
        """
        fitted, at = int(self.ends[0]), self._at(joints)
        parts = [(N[np.ix_(at, at)], b[at], square, count) for N, b, square, count in self.folds]
        gram, right = np.sum([part[0] for part in parts], axis=0), np.sum([part[1] for part in parts], axis=0)
        square, ridge = sum(part[2] for part in parts), _ridge(gram, fitted, self.variance)

        def evidence(N: Array, b: Array, total: float) -> float:
            L = np.linalg.cholesky(N + np.diag(ridge))
            white = np.linalg.solve(L, b)
            return (total - float(white @ white)) / self.variance + 2.0 * float(np.sum(np.log(np.diag(L))))

        whole = evidence(gram, right, square)
        out = [
            whole - evidence(gram - N, right - b, square - own) + count * np.log(self.variance)
            for N, b, own, count in parts
        ]
        return np.array(out)

    def kept_out(self, joints: Iterable[int]) -> float:
        """sum of squares of the residuals that the other folds predict with the curves of the given joints."""
        fitted, at = int(self.ends[0]), self._at(joints)
        gram = np.sum([f[0] for f in self.folds], axis=0)[np.ix_(at, at)]
        right = np.sum([f[1] for f in self.folds], axis=0)[at]
        total = 0.0
        for N, b, square, _ in self.folds:
            here, own = N[np.ix_(at, at)], b[at]
            x = _Normals(gram - here, right - own, fitted).solve(self.variance)
            total += square - 2.0 * float(x @ own) + float(x @ here @ x)
        return total


def _folded(present: Fit, columns: Sequence[Array], label: Array) -> _Folded:
    fitted = _scaled(present)
    X, r = np.column_stack([fitted, *columns]), present.residual
    folds = []
    for fold in np.unique(label):
        A, b = X[label == fold], r[label == fold]
        folds.append((A.T @ A, A.T @ b, float(b @ b), len(b)))
    ends = np.cumsum([fitted.shape[1], *(c.shape[1] for c in columns)])
    gram, right = np.sum([f[0] for f in folds], axis=0), np.sum([f[1] for f in folds], axis=0)
    return _Folded(tuple(folds), ends, _variance(present, X, gram, right, fitted.shape[1]))


def _variance(present: Fit, X: Array, gram: Array, right: Array, fitted: int) -> float:
    """Variance factor with the columns in the model: two rounds, from that without."""
    variance = present.variance_factor
    for _ in range(2):
        left = present.residual - X @ _Normals(gram, right, fitted).solve(variance)
        variance = float(left @ left) / max(len(left) - X.shape[1], 1)
    return variance


def _solve(present: Fit, columns: Sequence[Array]) -> list[Array]:
    fitted = _scaled(present)
    X = np.column_stack([fitted, *columns])
    gram, right = X.T @ X, X.T @ present.residual
    x = _Normals(gram, right, fitted.shape[1]).solve(_variance(present, X, gram, right, fitted.shape[1]))
    ends = np.cumsum([fitted.shape[1], *(c.shape[1] for c in columns)])
    return [x[a:b] for a, b in pairwise(ends)]


def _irregularity(cause: LinearCause, values: Array, angles: Array) -> float:
    """Share of a curve's variance at the recorded angles that a few waves of any order leave."""
    left = curve(Accepted(cause, cause.grid[0], values, np.zeros((0, 0))), angles)
    left = left - np.mean(left)
    total = float(left @ left)
    if total == 0.0:
        return 0.0
    for _ in range(WAVES):
        trials = []
        for order in np.arange(0.25, HIGHEST_WAVE, 0.25):
            wave = np.column_stack([np.ones(len(angles)), np.cos(order * angles), np.sin(order * angles)])
            # normal equations: three columns, and a share of a variance needs no digits
            rest = left - wave @ np.linalg.solve(wave.T @ wave + 1e-9 * len(angles) * np.eye(3), wave.T @ left)
            trials.append((float(rest @ rest), order, rest))
        left = min(trials, key=lambda t: t[0])[2]
    return float(left @ left) / total


LEAST_OVERLAP = np.deg2rad(120.0)
ALIKE = 0.75


def likenesses(accepted: Sequence[Accepted], angles: Sequence[Array]) -> tuple[Likeness, ...]:
    """For each curve the earlier one that it resembles most, turned and maybe reversed; slow waves do not count.

    Parameters
    ----------
    angles : recorded angles of the joint of each curve, rad: a curve is compared only where it was measured.
    """
    steps = 720
    grid = 2.0 * np.pi * np.arange(steps) / steps
    curves, known = [], []
    for item, q in zip(accepted, angles, strict=True):
        seen = np.zeros(steps, dtype=bool)
        at = np.round((q % (2.0 * np.pi)) / (2.0 * np.pi) * steps).astype(int)
        for shift in range(-4, 5):
            seen[(at + shift) % steps] = True
        y = curve(item, grid)
        slow = np.column_stack([np.ones(steps), *(f(m * grid) for m in (1, 2) for f in (np.cos, np.sin))])
        y = y - slow @ np.linalg.lstsq(slow[seen], y[seen], rcond=1e-6)[0]
        curves.append(y)
        known.append(seen)
    found = []
    for j in range(1, len(curves)):
        best: Likeness | None = None
        for i in range(j):
            for sense in (1, -1):
                # curve j at q against sense * curve i at sense * q + shift
                index = (sense * np.arange(steps)) % steps
                for shift in range(steps):
                    there = (index + shift) % steps
                    both = known[j] & known[i][there]
                    overlap = float(both.sum()) * 2.0 * np.pi / steps
                    if overlap < LEAST_OVERLAP:
                        continue
                    a, b = curves[j][both], sense * curves[i][there][both]
                    r = float(a @ b) / max(float(np.sqrt((a @ a) * (b @ b))), 1e-300)
                    if r > ALIKE and (best is None or r > best.correlation):
                        best = Likeness(
                            accepted[j].cause.where,
                            accepted[i].cause.where,
                            sense,
                            shift * 2.0 * np.pi / steps,
                            r,
                            overlap,
                        )
        if best is not None:
            found.append(best)
    return tuple(found)

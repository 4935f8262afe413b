"""What convinces of a diagnosis: for each cause what every pose says on its own, beside the fitted law.

Component-plus-residual plots (Larsen and McCleary, 1972) in the coordinate where the cause acts: with `d` the whitened
displacement of a pose's observations per unit of that coordinate, `c = d h` what the cause adds there and `r` what is
left after the whole fit, the pose alone says `d'(r + c) / d'd` with the standard deviation `1 / |d|`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from robcal.diagnosis.core.fitting import Accepted, Fit, fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.core.result import Diagnosis, Finding
from robcal.diagnosis.gain.heldout import cross_validated, folds, position_errors
from robcal.diagnosis.noise.swaps import find_swaps, relabelled
from robcal.diagnosis.scan.tangents import Tangents, tangents
from robcal.physics.cause import Array, Basis, Constants, ObservationCause
from robcal.robot.model import RobotModel
from robcal.robot.terms import identifier, names_in

LEAST_SHARE = 0.05
"""Poses on which the effect moves the observations by less than this share of the largest say nothing about it."""
GRID = 241


@dataclass(frozen=True)
class CauseEvidence:
    """One cause, pose by pose.

    Attributes
    ----------
    cause, where, direction : as in diagnosis.json.
    coordinate : what the values are: ``<frame>.<kind>`` (rad or m), or 'share' of the fitted effect.
    poses : (n,) names; kept_out : (n,) true for poses that took no part.
    measured, sigma, fitted : (n,) the coordinate as each pose alone says, its standard deviation, the fitted law.
    variables : covariates of the law, (n,) each; the first one is to be the abscissa.
    curves : label -> (abscissa, value) of the fitted law where it is a line over the first covariate.
    """

    cause: str
    where: str
    direction: str | None
    coordinate: str
    poses: tuple[str, ...]
    kept_out: Array
    measured: Array = field(repr=False)
    sigma: Array = field(repr=False)
    fitted: Array = field(repr=False)
    variables: Mapping[str, Array] = field(repr=False)
    curves: Mapping[str, tuple[Array, Array]] = field(repr=False)


@dataclass(frozen=True)
class Evidence:
    """All causes, and the position errors before and after the diagnosis.

    Attributes
    ----------
    kind : 'verify' (poses that took no part) or 'cross-validation'.
    poses : (m,) name of the pose of each error; before, after : (m,) m, root of the mean square within the pose.
    """

    causes: tuple[CauseEvidence, ...]
    kind: str
    poses: tuple[str, ...]
    before: Array
    after: Array


def evidence_of(
    model: RobotModel, recording: Recording, free: Sequence[str], verify: Recording | None, diagnosis: Diagnosis
) -> Evidence:
    """Evidence for a diagnosis of a recording.

    Parameters
    ----------
    model, free : the robot as it was identified, before the diagnosis, and its fitted parameters.
    """
    swaps = find_swaps(recording) if any(f.cause.kind.is_relabelling for f in diagnosis.findings) else ()
    clean = relabelled(recording, swaps)
    clean = clean.subset(~np.isin(np.array(clean.names), diagnosis.blunders))
    findings = [f for f in diagnosis.findings if not f.cause.kind.is_relabelling]
    direct = [
        Accepted(f.cause, f.constants, f.values, f.covariance)
        for f in findings
        if isinstance(f.cause, ObservationCause)
    ]
    after = fit(diagnosis.model, clean, diagnosis.free, direct)
    before = fit(model, recording, free)
    # pose by pose: errors common to all poses are taken off as they were estimated
    alone = replace(clean, common=None)
    analyses = [(tangents(after, alone), clean.given_common(after.residual), alone, False)]
    if verify is not None:
        tested = relabelled(verify, swaps)
        there, alone = _elsewhere(after, tested), replace(tested, common=None)
        analyses.append((tangents(there, alone), _left_over(there, alone), alone, True))
        errors = [position_errors(r, f) for r, f in ((verify, before), (tested, after))]
        rows = verify.observations.pose
        names = verify.names
    else:
        errors = [cross_validated(r, f, folds(r)) for r, f in ((recording, before), (clean, after))]
        rows, names = recording.observations.pose, recording.names
    scale = float(np.sqrt(after.variance_factor))
    causes = tuple(e for finding in findings if (e := _cause(finding, analyses, scale)) is not None)
    first = _by_pose(errors[0], rows, names)
    second = first if not diagnosis.findings else _by_pose(errors[1], *_pose_rows(clean if verify is None else verify))
    both = [name for name in first if name in second]
    kind = "verify" if verify is not None else "cross-validation"
    return Evidence(causes, kind, tuple(both), np.array([first[n] for n in both]), np.array([second[n] for n in both]))


def _pose_rows(recording: Recording) -> tuple[Array, tuple[str, ...]]:
    return recording.observations.pose, recording.names


def _by_pose(errors: Array, rows: Array, names: Sequence[str]) -> dict[str, float]:
    square = np.sum(errors**2, axis=1)
    return {names[int(p)]: float(np.sqrt(np.mean(square[rows == p]))) for p in np.unique(rows)}


def _elsewhere(fitted: Fit, recording: Recording) -> Fit:
    """A fit looked at from other poses: nothing is fitted to them."""
    inputs = recording.inputs(fitted.kernel)
    frames, J = fitted.kernel.frames_and_jacobian(fitted.theta, inputs)
    alone = replace(recording, common=None)
    residual, _ = alone.linearise(frames, J[:, :, :1])
    if recording.common is not None and fitted.common is not None:
        residual = residual - alone.whiten(recording.common, frames) @ fitted.common
    observed = recording.observations.pose
    row_pose = np.repeat(observed, len(residual) // len(observed))
    return replace(fitted, inputs=inputs, frames=frames, residual=residual, row_pose=row_pose)


def _left_over(there: Fit, recording: Recording) -> Array:
    """Residuals (m,) at other poses, displacements of observation causes taken off."""
    residual = there.residual
    at = tangents(there, recording)
    for item in there.accepted:
        if isinstance(item.cause, ObservationCause):
            residual = residual - at.columns(item.cause, item.constants) @ item.values
    return residual


Look = tuple[Tangents, Array, Recording, bool]


def _cause(finding: Finding, analyses: Sequence[Look], scale: float) -> CauseEvidence | None:
    """Evidence for one cause over all analyses; None where no pose says anything."""
    group = _group(finding, analyses[0][0])
    parts = [_of_group(finding, group, *analysis) if group else _of_share(finding, *analysis) for analysis in analyses]
    names = _abscissa_first(finding, group, analyses[0][0])
    poses: list[str] = []
    kept: list[bool] = []
    measured, sigma, fitted = [], [], []
    values: dict[str, list[Array]] = {name: [] for name in names}
    for (d2, y, h), (at, _, recording, kept_out) in zip(parts, analyses, strict=True):
        enough = d2 > (LEAST_SHARE**2) * max(float(np.max(p[0], initial=0.0)) for p in parts)
        enough &= d2 > 0
        poses += [recording.names[i] for i in np.flatnonzero(enough)]
        kept += [kept_out] * int(enough.sum())
        measured.append(y[enough])
        sigma.append(scale / np.sqrt(d2[enough]))
        fitted.append(h[enough])
        for name in names:
            column = np.broadcast_to(np.asarray(at.variables[name], dtype=float), d2.shape)
            values[name].append(column[enough])
    if not poses:
        return None
    cause = finding.cause
    variables = {name: np.concatenate(columns) for name, columns in values.items()}
    curves = _curves(group, variables) if group else {}
    return CauseEvidence(
        cause.name,
        cause.where,
        cause.direction,
        f"{group[0][0].frame}.{group[0][0].kind}" if group else "share",
        tuple(poses),
        np.array(kept, dtype=bool),
        np.concatenate(measured),
        np.concatenate(sigma),
        np.concatenate(fitted),
        variables,
        curves,
    )


Group = list[tuple[Basis, float]]


def _group(finding: Finding, at: Tangents) -> Group:
    """The laws (with their amplitudes) that act on the one coordinate where the cause moves the observations most."""
    cause = finding.cause
    bases = list(cause.laws(finding.constants))
    if cause.free_parameters:
        freed = zip(cause.free_parameters, cause.parameters, strict=True)
        bases = [b for name, short in freed if (b := _freed(name, short, at))]
        if len(bases) != len(cause.free_parameters):
            return []
    amplitude = dict(zip(cause.names(finding.constants), map(float, finding.values), strict=True))
    groups: dict[tuple[str, str], Group] = {}
    for basis in bases:
        groups.setdefault((basis.frame, basis.kind), []).append((basis, amplitude[basis.parameter]))

    def strength(key: tuple[str, str]) -> float:
        return float(np.linalg.norm(at.motion[key] * _law(groups[key], at)[at.row_pose]))

    return groups[max(groups, key=strength)] if groups else []


def _freed(name: str, short: str, at: Tangents) -> Basis | None:
    """A parameter of the kernel that was set free, as a law: an elasticity turns its angle by its moment."""
    frame, _, kind = name.rpartition(".")
    angle = kind.removeprefix("elastic_")
    moment = f"{identifier(frame)}_m{angle}"
    if kind.startswith("elastic_") and (frame, angle) in at.motion and moment in at.variables:
        return Basis(frame, angle, moment, short)
    return None


def _law(group: Group, at: Tangents) -> Array:
    """Value (n,) of the laws of a group together."""
    shape = np.shape(at.variables["index"])
    parts = [value * np.broadcast_to(b.value(at.variables), shape) for b, value in group]
    return np.asarray(np.sum(parts, axis=0), dtype=float)


def _of_group(finding: Finding, group: Group, at: Tangents, residual: Array, recording: Recording, kept: bool) -> tuple:
    """Square of |d|, the pose's own value and the law's, (n,) each, in the coordinate of the group."""
    n = len(recording.names)
    d = at.motion[group[0][0].frame, group[0][0].kind]
    h = _law(group, at)
    d2 = np.bincount(at.row_pose, d * d, minlength=n)
    along = np.bincount(at.row_pose, d * residual, minlength=n)
    return d2, h + along / np.where(d2 > 0, d2, 1.0), h


def _of_share(finding: Finding, at: Tangents, residual: Array, recording: Recording, kept: bool) -> tuple:
    """The same as a share of the whole effect: 1 where the pose shows it as fitted, 0 where not at all."""
    n = len(recording.names)
    present = at.columns(finding.cause, finding.constants) @ finding.values
    everywhere: Constants = finding.constants
    if "pose" in finding.constants:  # what happens at a pose is looked for before it, too
        everywhere = {**finding.constants, "pose": -1e9}
    d = at.columns(finding.cause, everywhere) @ finding.values
    d2 = np.bincount(at.row_pose, d * d, minlength=n)
    safe = np.where(d2 > 0, d2, 1.0)
    own = np.bincount(at.row_pose, d * (residual + present), minlength=n) / safe
    return d2, own, np.bincount(at.row_pose, d * present, minlength=n) / safe


def _abscissa_first(finding: Finding, group: Group, at: Tangents) -> tuple[str, ...]:
    """Covariates of the law, the one with the most values first; the order of the poses where there is none."""
    names = {name for basis, _ in group for name in names_in(basis.expression)}
    if not group:
        names = {"index"} if "pose" in finding.constants else set(finding.cause.covariates)
    known = [name for name in names if name in at.variables]
    several = [name for name in known if len(np.unique(at.variables[name])) > 1]
    ordered = sorted(several, key=lambda name: (-len(np.unique(np.round(at.variables[name], 6))), name))
    return tuple(ordered) or ("index",)


def _curves(group: Group, variables: Mapping[str, Array]) -> dict[str, tuple[Array, Array]]:
    """Lines of the law over its first covariate, one for each approach direction where it depends on one."""
    first, *others = variables
    if len(others) > 1 or any(not np.isin(variables[name], (-1.0, 0.0, 1.0)).all() for name in others):
        return {}
    x = np.linspace(float(np.min(variables[first])), float(np.max(variables[first])), GRID)
    states: list[dict[str, float]] = [{}]
    if others:
        states = [{others[0]: float(v)} for v in np.unique(variables[others[0]])]
    out = {}
    for state in states:
        at = {first: x, **{name: np.full(GRID, value) for name, value in state.items()}}
        if any(name not in at for basis, _ in group for name in names_in(basis.expression)):
            return {}
        y = np.sum([value * np.broadcast_to(b.value(at), x.shape) for b, value in group], axis=0)
        out[", ".join(f"{name} {value:+.0f}" for name, value in state.items()) or "fitted law"] = (x, y)
    return out

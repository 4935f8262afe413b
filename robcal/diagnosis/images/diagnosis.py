"""Diagnosis of image residuals: detection, naming and gain for surveys and stations, to first order."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from robcal.cause import Cause, Kind
from robcal.diagnosis.scan.family_wise import FamilyWise, simulate
from robcal.diagnosis.scan.statistics import (
    Entry,
    ScanResult,
    Stack,
    log_f_probability,
    orthonormal_basis,
    scan,
    stack_entries,
)
from robcal.physics.cause import Array, numeric_sigma
from robcal.physics.images.cause import ImageCause
from robcal.physics.images.causes import image_causes, neighbouring_moves
from robcal.physics.images.data import ImageData

LEVEL = 0.002
"""Family-wise level. Marks share small errors that their covariance does not know, and a robot's own diagnosis adds its
false alarms to these."""
MOST = 5
RUNS = 200
NEARLY_AS_GOOD = 3.0
"""Logarithm of the odds within which another cause stays a rival."""
ADEQUATE = 1e-3
DEGENERATE = 1e-6
"""Singular values below this share of the largest are directions that the images do not show."""
ALIKE, ALIKE_DIRECTION, CLASS = 1.6, 0.9, 3
"""Ratio of sizes, cosine of directions within which shifts are alike; so many alike are no set of single shifts."""
LEFT_OVER = 0.2
"""Significance of a smooth field beside a named cause, and its share of what that explains, from which the name does
not hold."""


@dataclass(frozen=True)
class ImageFinding(Cause):
    """A cause found in images, as reported.

    `rivals` are (kind, where) of others that explain the images (nearly) as well; `heldout_px` the root mean square
    of the marks, each predicted without itself, before and after.
    """

    parameters: dict[str, object]
    sigma: dict[str, object]
    p_value: float
    rivals: tuple[tuple[Kind, str], ...]
    heldout_px: tuple[float, float]
    statement: str


@dataclass(frozen=True)
class ImageDiagnosis:
    """Findings in the order in which they were accepted; `unexplained_p` of the last scan; rms of predicted marks."""

    findings: tuple[ImageFinding, ...]
    p_value: float
    unexplained_p: float
    heldout_px: tuple[float, float, float]


@dataclass(frozen=True)
class _Accepted:
    """A cause that was accepted: whitened columns (r, q) beside the images' unknowns, per `cause.sizes`."""

    cause: ImageCause
    columns: Array
    values: Array
    covariance: Array
    inflation: float
    p_value: float
    rivals: tuple[tuple[Kind, str], ...]
    heldout_px: tuple[float, float]


def diagnose_images(data: ImageData, *, moves: bool = True, level: float = LEVEL, seed: int = 0) -> ImageDiagnosis:  # noqa: PLR0915 - one search, step by step
    """Find what the model of the images leaves out.

    Weakness: everything is linear in the parameters of a cause; a strong effect is right in kind and place, its
    size to first order only.
    """
    causes = list(image_causes(data, moves))
    listed = [Entry(i, 0, data.whiten(cause.columns) * cause.sizes) for i, cause in enumerate(causes)]
    listed = [entry for entry in listed if np.all(np.isfinite(entry.columns))]
    residual, added = data.residual, np.zeros((len(data.residual), 0))
    redundancy = data.redundancy.reshape(-1).copy()
    accepted: list[_Accepted] = []
    predicted = _predicted(data, residual, redundancy)
    before = predicted
    level_of = None
    fields: dict[str, Array] = {}
    last_p = dropped_p = 1.0
    while listed and len(accepted) <= MOST:

        def remove(columns: Array, basis: Array = added) -> Array:
            return _without(basis, data.remove(columns))

        stacks = stack_entries(listed, remove)
        freedom = data.freedom - added.shape[1]
        inflation = _inflation(causes, stacks, data, residual)
        result = scan([_scaled(stack, inflation) for stack in stacks], residual, freedom)
        fields = fields or _fields(causes, stacks)
        level_of = level_of or simulate(stacks, remove, freedom, len(residual), runs=RUNS, seed=seed)
        last_p = level_of.probability(float(result.log_p[result.best]))
        if last_p > level or len(accepted) == MOST:
            break
        chosen, score = _best(causes, result, level_of, level)
        near = list(neighbouring_moves(data, causes[chosen])) if causes[chosen].pose is not None else []
        if near:
            more = [Entry(len(causes) + k, 0, data.whiten(c.columns) * c.sizes) for k, c in enumerate(near)]
            causes += near
            stacks = (*stacks, *stack_entries(more, remove))
            inflation = np.concatenate([inflation, np.full(len(near), inflation[chosen])])
            result = scan([_scaled(stack, inflation) for stack in stacks], residual, freedom)
            chosen, score = _best(causes, result, level_of, level)
        cause = causes[chosen]
        basis, values, covariance = _estimate(stacks, chosen, residual, result.variance_factor, cause.sizes)
        left = _without(basis, residual)
        remaining = np.maximum(redundancy - np.sum(basis[: len(redundancy)] ** 2, axis=1), 1e-3)
        after = _predicted(data, left, remaining)
        gained = after <= (1.0 - cause.least_gain) * predicted
        if not (cause.plausible(values) and gained and _adequate(fields, cause, basis, residual, freedom)):
            dropped_p = min(dropped_p, last_p)
            listed = [entry for entry in listed if entry.cause != chosen]
            continue
        residual, redundancy = left, remaining
        rivals = _rivals(causes, score, chosen)
        columns = remove(data.whiten(cause.columns) * cause.sizes, np.zeros((len(residual), 0)))
        accepted.append(
            _Accepted(cause, columns, values, covariance, float(inflation[chosen]), last_p, rivals, (predicted, after))
        )
        if cause.once:
            same = {i for i, c in enumerate(causes) if (c.kind, c.where) == (cause.kind, cause.where)}
            listed = [entry for entry in listed if entry.cause not in same]
        predicted = after
        added = np.concatenate([added, basis], axis=1)
    findings = [f for item in _together(accepted, data, residual) for f in _findings(item)]
    findings, left_over = _believable(findings, min(last_p, dropped_p))
    p_value = findings[0].p_value if findings else last_p
    return ImageDiagnosis(tuple(findings), p_value, left_over, (before, predicted, data.sigma_px))


def _believable(findings: list[ImageFinding], left_over: float) -> tuple[list[ImageFinding], float]:
    """Findings that what is left over does not call into question, and the p-value of what is left over then."""
    if left_over < ADEQUATE:
        # images that are bent in a manner which nothing explains make single targets look displaced
        findings = [f for f in findings if f.kind.moves != "target" or f.p_value < left_over]
    classed = _moving_alike(findings)
    return [f for f in findings if f not in classed], min([left_over, *(f.p_value for f in classed)])


def _moving_alike(findings: Sequence[ImageFinding]) -> list[ImageFinding]:
    """Shifts of targets that agree in direction and size: dots of one kind, whose centres share an error of the images.

    Dots on posts, beside an edge, or on one side of a plate are displaced together by what surrounds them; single
    targets that were really moved have no reason to agree.
    """
    shifted = [f for f in findings if f.kind.moves == "target" and "shift_mm" in f.parameters]
    shifts = np.array([f.parameters["shift_mm"] for f in shifted], dtype=float).reshape(-1, 3)
    size = np.linalg.norm(shifts, axis=1)
    if len(shifted) < CLASS or not np.all(size > 0):
        return []
    unit = shifts / size[:, None]
    alike = (unit @ unit.T > ALIKE_DIRECTION) & (size[:, None] < ALIKE * size) & (size < ALIKE * size[:, None])
    largest = alike[int(np.argmax(alike.sum(axis=1)))]
    return [f for f, same in zip(shifted, largest, strict=True) if same] if largest.sum() >= CLASS else []


def _together(accepted: Sequence[_Accepted], data: ImageData, residual: Array) -> list[_Accepted]:
    """Values and covariances of all accepted causes estimated beside each other.

    Each was found before the later ones were known, whose share its first estimate has in it. One whose own value
    would then be none that physics allows keeps its first.
    """
    if len(accepted) < 2:
        return list(accepted)
    size = np.concatenate([item.cause.sizes for item in accepted])
    U, s, Vt = np.linalg.svd(np.concatenate([item.columns for item in accepted], axis=1), full_matrices=False)
    seen = s > DEGENERATE * s[0]
    inverse = Vt[seen].T / s[seen]
    values = inverse @ (U[:, seen].T @ data.residual) * size
    variance = float(residual @ residual) / max(data.freedom - int(seen.sum()), 1)
    covariance = variance * (inverse @ inverse.T) * np.outer(size, size)
    out, at = [], 0
    for item in accepted:
        own = slice(at, at + len(item.values))
        at = own.stop
        if item.cause.plausible(values[own]):
            item = replace(item, values=values[own], covariance=covariance[own, own])
        out.append(item)
    return out


def _findings(item: _Accepted) -> Iterator[ImageFinding]:
    """A cause as reported, at each of its places."""
    cause = item.cause
    reported, sigma = numeric_sigma(cause.report, item.values, {}, item.covariance * item.inflation)
    for where in cause.locations:
        text = cause.describe(where, reported)
        yield ImageFinding(
            cause.kind, where, cause.direction, reported, sigma, item.p_value, item.rivals, item.heldout_px, text
        )


def _adequate(fields: Mapping[str, Array], cause: ImageCause, basis: Array, residual: Array, freedom: int) -> bool:
    """Whether a smooth field over the camera's image finds nothing beside a cause that bends images itself.

    What a lens model leaves over looks partly like refraction; the name holds only if it explains (nearly) all of it.
    """
    known = [fields[name] for name in cause.locations if name in fields]
    if not cause.bends or not known:
        return True
    explained = float(np.sum((basis.T @ residual) ** 2))
    left = _without(basis, residual)
    beside = orthonormal_basis(_without(basis, np.concatenate(known, axis=1)))
    raw, count = float(np.sum((beside.T @ left) ** 2)), beside.shape[1]
    total = float(left @ left)
    log_p = float(log_f_probability(np.array(raw), np.array(count), total, freedom - basis.shape[1]))
    return log_p > np.log(ADEQUATE) or raw - count < LEFT_OVER * explained


def _fields(causes: Sequence[ImageCause], stacks: Sequence[Stack]) -> dict[str, Array]:
    """Orthonormal columns of the smooth field of each camera, beside what the images' unknowns absorb."""
    return {
        causes[index].where: stack.basis[e]
        for stack in stacks
        for e, index in enumerate(stack.cause)
        if not causes[index].kind.named and stack.count[e] > 0
    }


def _inflation(causes: Sequence[ImageCause], stacks: Sequence[Stack], data: ImageData, residual: Array) -> Array:
    """(causes,) factors by which scores scatter more than the noise of single marks says.

    Errors that the marks of an image (or of a target) have in common make every image and every target look
    displaced; only what stands out from the others is one. The median is hardly moved by the few that are.
    """
    factor = np.array([data.inflation.get(cause.name, 1.0) for cause in causes])
    shifted = np.array([cause.kind.moves == "target" for cause in causes])
    bases = [stack.basis[e] for stack in stacks for e in np.flatnonzero(shifted[stack.cause] & (stack.count > 0))]
    if bases:
        factor[shifted] = max(1.0, spread_of_others(bases, residual))
    return factor


def spread_of_others(bases: Sequence[Array], residual: Array) -> float:
    """Median test of targets (orthonormal columns (r, c) each) by its expectation, the most suspect one set free.

    One displaced target makes all others of a body of few look displaced as long as it is believed.
    """
    worst = int(np.argmax([np.sum((basis.T @ residual) ** 2) for basis in bases]))
    left = _without(bases[worst], residual)
    others = [orthonormal_basis(_without(bases[worst], b)) for k, b in enumerate(bases) if k != worst]
    others = [basis for basis in others if basis.shape[1]]
    if not others:
        return 1.0
    ratio = [np.sum((basis.T @ left) ** 2) / stats.chi2.median(basis.shape[1]) for basis in others]
    return float(np.median(ratio))


def _scaled(stack: Stack, inflation: Array) -> Stack:
    """The stack with scores divided by the root of their inflation."""
    root = np.sqrt(inflation[stack.cause])
    return replace(stack, basis=stack.basis / root[:, None, None], singular=stack.singular / root[:, None])


def _without(basis: Array, columns: Array) -> Array:
    return np.asarray(columns - basis @ (basis.T @ columns))


def _predicted(data: ImageData, residual: Array, redundancy: Array) -> float:
    """Root mean square in px of the marks, each predicted from all others (residual by its redundancy number)."""
    usable = redundancy > 0.05
    marks = residual[: len(redundancy)]
    return float(np.sqrt(np.mean((marks[usable] / redundancy[usable]) ** 2))) * data.sigma_px


def _best(causes: Sequence[ImageCause], result: ScanResult, level_of: FamilyWise, level: float) -> tuple[int, Array]:
    """Candidate with the most evidence, and log-odds (causes,) of all; what is not significant itself is none."""
    score = np.full(len(causes), -np.inf)
    for index, evidence, log_p in zip(result.cause, result.log_evidence, result.log_p, strict=True):
        if level_of.probability(float(log_p)) <= level:
            score[index] = evidence + np.log(causes[index].weight)
    return int(np.argmax(score)), score


def _estimate(
    stacks: Sequence[Stack], chosen: int, residual: Array, variance: float, sizes: Array
) -> tuple[Array, Array, Array]:
    for stack in stacks:
        for e in np.flatnonzero(stack.cause == chosen):
            seen = stack.singular[e] > 0
            basis = stack.basis[e][:, seen]
            right = stack.right[e][seen]
            inverse = right.T / stack.singular[e][seen]
            values = (inverse @ (basis.T @ residual)) * sizes
            covariance = variance * (inverse @ inverse.T) * np.outer(sizes, sizes)
            return basis, values, covariance
    raise LookupError("the chosen cause is not among the tested ones")


def _rivals(causes: Sequence[ImageCause], score: Array, chosen: int) -> tuple[tuple[Kind, str], ...]:
    own = {(causes[chosen].kind, where) for where in causes[chosen].locations}
    near = [i for i in np.argsort(-score) if score[i] > score[chosen] - NEARLY_AS_GOOD and causes[i].kind.named]
    listed = dict.fromkeys([*causes[chosen].twins, *((causes[i].kind, w) for i in near for w in causes[i].locations)])
    return tuple(rival for rival in listed if rival not in own)

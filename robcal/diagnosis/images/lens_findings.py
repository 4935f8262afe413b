"""What surveys and stations found and corrected by themselves, as causes: lens groups left out of a camera's file,
cameras that moved, targets that sit elsewhere.

A survey whose check lengths contradict its scale: a scale bar is not as long as its certificate says.

The errors of all check lengths are estimated as one scale, with the covariance that they share through the network. A
single contradicting check length, or several that no scale explains, are left to the report: then it is they that are
in doubt.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from robcal.cause import Kind
from robcal.diagnosis.images.diagnosis import ImageFinding
from robcal.photogrammetry.bundle.lengths import distances
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera
from robcal.photogrammetry.core.network import CameraNetwork
from robcal.photogrammetry.station.contradictions import LENS_AFFINITY, LENS_KINDS, LENS_TANGENTIAL, TARGET_SWAPPED
from robcal.photogrammetry.station.network import StationCause, StationOrientation
from robcal.physics.measuring import SCALE_ERROR
from robcal.physics.refraction import REFRACTION
from robcal.transforms import Array

LEVEL = 1e-4
"""Significance from which a lens group is a cause. Marks of an image share small errors, hence more than 1 %."""

TANGENTIAL = 0.01
AFFINITY = 2e-3
"""Decentring (|p1|, |p2|) and relative difference of fx and fy beyond which no lens or sensor is built: glass or water
in front of it bends images so."""
EXCHANGED = 0.05
"""Two shifted targets are swapped if they miss each other's place by less than this share of their distance."""


def survey_findings(network: CameraNetwork, start: Camera | None, name: str) -> tuple[ImageFinding, ...]:
    """Lens groups that the given camera file has at zero and the self-calibration finds significant.

    Wald test on the adjusted numbers; "before" is the root mean square that the images would have without the group,
    everything else adjusted anew to first order; both as errors of marks that are predicted without themselves.
    """
    if start is None:
        return ()
    found = []
    marks = len(network.marks)
    rms, alone = network.rms_px, _predicted(marks, network.redundancy_total)
    for kind in LENS_KINDS:
        group = kind.intrinsics
        if kind == LENS_AFFINITY:
            given, contrast = start.fy - start.fx, _difference()
        else:
            given = float(np.abs([getattr(start, n) for n in group]).max())
            contrast = np.array(
                [[float(n == m) for m in INTRINSIC_NAMES] for n in group if n in network.free_intrinsics]
            )
        if abs(given) > 1e-9 or not len(contrast):
            continue
        values = contrast @ network.camera.vector
        covariance = contrast @ network.intrinsics_covariance @ contrast.T
        if not np.all(np.diag(covariance) > 0):
            continue
        statistic = float(values @ np.linalg.solve(covariance, values))
        p_value = float(stats.chi2.sf(statistic, len(values)))
        before = float(np.sqrt(rms**2 + statistic * network.sigma0_px**2 / (2 * marks)))
        if p_value > LEVEL:
            continue
        names = ["fy_minus_fx_px"] if kind == LENS_AFFINITY else [n for n in group if n in network.free_intrinsics]
        reported = dict(zip(names, map(float, values), strict=True))
        sigma = dict(zip(names, map(float, np.sqrt(np.diag(covariance))), strict=True))
        found.append(
            (
                statistic,
                ImageFinding(
                    kind,
                    name,
                    None,
                    dict(reported),
                    dict(sigma),
                    p_value,
                    (),
                    (alone * before, alone * rms),
                    kind.describe(name, reported),
                ),
            )
        )
    return tuple(finding for _, finding in sorted(found, key=lambda item: -item[0]))


def _predicted(marks: int, redundancy: float) -> float:
    """Factor from residuals to errors of marks predicted without themselves: one by the mean redundancy number."""
    return 2 * marks / redundancy if redundancy > 0 else float("nan")


def _difference() -> Array:
    row = np.zeros((1, len(INTRINSIC_NAMES)))
    row[0, INTRINSIC_NAMES.index("fy")], row[0, INTRINSIC_NAMES.index("fx")] = 1.0, -1.0
    return row


def station_findings(
    orientation: StationOrientation,
    pose_names: tuple[str, ...],
    given: Body | None = None,
    inflation: Mapping[str, float] | None = None,
    explained: frozenset[str] = frozenset(),
) -> Iterator[ImageFinding]:
    """Recurring contradictions that the station's adjustment freed, strongest first.

    Parameters
    ----------
    pose_names : names of all poses. given : the body with the coordinates of its file, to see exchanged targets.
    inflation : cause -> factor by which such scores scatter where nothing is wrong (errors common to an image).
    explained : targets whose place is explained already.
    """
    marks = len(orientation.marks)
    rms, alone = orientation.rms_px, _predicted(marks, orientation.redundancy_total)
    for item in sorted(_with_swaps(orientation.evidence, given), key=lambda e: -e.statistic):
        reported, sigma, text = _reported(orientation, item, pose_names)
        if reported is None:
            continue
        statistic = item.statistic / (inflation or {}).get(item.name, 1.0)
        p_value = float(stats.chi2.sf(statistic, item.degrees))
        if p_value > LEVEL or (item.kind.moves == "target" and item.where in explained):
            continue
        before = float(np.sqrt(rms**2 * (1.0 + item.statistic / (2 * marks)))) if np.isfinite(statistic) else np.nan
        rivals: tuple[tuple[Kind, str], ...] = ()
        if item.kind.moves == "camera" and len(orientation.names) == 2 and not item.alone:
            other = next(name for name in orientation.names if name != item.where)
            rivals = ((item.kind, other),)
        yield ImageFinding(
            item.kind, item.where, None, reported, sigma, p_value, rivals, (alone * before, alone * rms), text
        )


def beyond_lenses(findings: Sequence[ImageFinding], cameras: Mapping[str, Camera]) -> tuple[ImageFinding, ...]:
    """Findings in which lens terms of a size that no lens has are reported as what they stand for: refraction.

    A camera analyses through glass or water; in few images decentring and affinity take over most of what that does.
    Where refraction is found on the same camera too, the terms are reported beside it, as what it is hard to tell from.

    Parameters
    ----------
    cameras : adjusted interior orientation by name, of the cameras that the findings speak of.
    """
    strange = [f for f in findings if f.where in cameras and _strange(f, cameras[f.where])]
    out = [f for f in findings if f not in strange]
    for where in dict.fromkeys(f.where for f in strange):
        terms = [f for f in strange if f.where == where]
        rivals = tuple((f.kind, where) for f in terms)
        at = next((i for i, f in enumerate(out) if (f.kind, f.where) == (REFRACTION, where)), None)
        if at is not None:
            least = min(f.p_value for f in (out[at], *terms))
            out[at] = replace(out[at], rivals=(*out[at].rivals, *rivals), p_value=least)
            continue
        formula = "; ".join(f"{name} = {value:.4g}" for f in terms for name, value in f.parameters.items())
        term = {"variables": ["x_px", "y_px"], "kind": "formula", "formula": f"lens terms {formula}"}
        best = min(terms, key=lambda f: f.p_value)
        text = (
            f"Camera {where} analyses through glass or water: its images are bent more than any lens does ({formula})"
        )
        parameters: dict[str, object] = {"term": term}
        out.append(replace(best, kind=REFRACTION, parameters=parameters, sigma={}, rivals=rivals, statement=text))
    return tuple(sorted(out, key=lambda f: f.kind != REFRACTION)) if strange else tuple(findings)


def _strange(finding: ImageFinding, camera: Camera) -> bool:
    if finding.kind == LENS_TANGENTIAL:
        return max(abs(camera.p1), abs(camera.p2)) > TANGENTIAL
    return finding.kind == LENS_AFFINITY and abs(camera.fy - camera.fx) > AFFINITY * camera.fx


def _with_swaps(evidence: Sequence[StationCause], given: Body | None) -> list[StationCause]:
    """Two targets of which each sits where the file has the other are swapped, not shifted."""
    left = list(evidence)
    if given is None:
        return left
    shifted = [item for item in evidence if item.kind.moves == "target"]
    for k, a in enumerate(shifted):
        for b in shifted[k + 1 :]:
            i, j = (int(given.index([int(item.where)])[0]) for item in (a, b))
            way = given.points[j] - given.points[i]
            near = EXCHANGED * float(np.linalg.norm(way))
            exchange = np.linalg.norm(a.estimate - way) < near and np.linalg.norm(b.estimate + way) < near
            if exchange and a in left and b in left:
                left.remove(a)
                left.remove(b)
                statistic = a.statistic + b.statistic
                left.append(
                    StationCause(
                        TARGET_SWAPPED,
                        a.where,
                        None,
                        None,
                        way,
                        a.covariance,
                        statistic,
                        6,
                        a.statement,
                        partner=b.where,
                    )
                )
    return left


def _reported(
    orientation: StationOrientation, item: StationCause, pose_names: tuple[str, ...]
) -> tuple[dict[str, object] | None, dict[str, object], str]:
    """Parameters, sigmas and sentence of what the adjustment freed; None for what is no cause."""
    spread = np.sqrt(np.clip(np.diag(item.covariance), 0.0, None))
    reported: dict[str, object]
    if item.kind.intrinsics:
        camera = orientation.cameras[orientation.names.index(item.where)]
        free = [n for n in item.kind.intrinsics if n in {"p1", "p2", *orientation.free_interior[item.where]}]
        if item.kind == LENS_AFFINITY:
            reported = {"fy_minus_fx_px": camera.fy - camera.fx}
        else:
            reported = {name: float(getattr(camera, name)) for name in free}
        sigma: dict[str, object] = dict(zip(reported, map(float, spread), strict=False))
        return reported, sigma, item.kind.describe(item.where, reported)
    if item.kind.moves == "camera" and item.pose is not None:
        label = pose_names[item.pose]
        scale = np.r_[np.full(3, 1e3), np.full(3, np.degrees(1.0))]
        moved, covariance = item.estimate, item.covariance
        of_camera = orientation.exterior_camera == orientation.names.index(item.where)
        if item.pose in orientation.exterior_first_pose[of_camera]:  # as adjusted, not as tested for
            moved, covariance = orientation.movement(item.where, item.pose)
        values, sigmas = moved * scale, np.sqrt(np.clip(np.diag(covariance), 0.0, None)) * scale
        reported = {"pose": label, "shift_mm": values[:3].tolist(), "turn_deg": values[3:].tolist()}
        size = f" by {np.linalg.norm(values[:3]):.3f} mm and {np.linalg.norm(values[3:]):.4f} deg"
        text = item.kind.describe(item.where, reported) + size
        return reported, {"shift_mm": sigmas[:3].tolist(), "turn_deg": sigmas[3:].tolist()}, text
    if item.kind.is_relabelling:
        reported = {"with": int(item.partner)}
        return reported, {}, item.kind.describe(item.where, reported)
    if item.kind.moves == "target":
        reported = {"shift_mm": (item.estimate * 1e3).tolist()}
        return reported, {"shift_mm": (spread * 1e3).tolist()}, item.kind.describe(item.where, reported)
    return None, {}, ""


SCALE_LEVEL = 1e-4
"""Significance of a scale, two-sided."""
ADEQUATE = 1e-3
"""Significance of what is left of the check lengths from which one scale does not explain them."""
FEWEST = 2


def scale_findings(network: CameraNetwork, body: str) -> tuple[ImageFinding, ...]:
    """The scale of a survey against its check lengths.

    Weakness: whether the scale bars or the check lengths are wrong, these measurements cannot tell; nothing is
    corrected.
    """
    checks = [check for check in network.check_lengths if check.sigma > 0]
    if len(checks) < FEWEST:
        return ()
    rows = network.index_of([target for check in checks for target in check.ids]).reshape(-1, 2)
    J = distances(network.points, rows)[1]
    covariance = J @ network.points_covariance @ J.T
    # the certificates' own variances stand on the diagonal only
    own = np.array([check.sigma**2 for check in checks])
    covariance[np.diag_indices(len(checks))] = np.maximum(own, np.diag(covariance))
    error = np.array([check.error for check in checks])
    length = np.array([check.expected for check in checks])
    scale, sigma, left = _common_scale(error, length, covariance)
    p_value = float(2.0 * stats.norm.sf(abs(scale) / sigma))
    if p_value > SCALE_LEVEL or float(stats.chi2.sf(left, len(checks) - 1)) < ADEQUATE:
        return ()
    ppm = 1e6 * scale
    way = "long" if ppm > 0 else "short"
    text = (
        f"Body {body} was surveyed {abs(ppm):.0f} ppm too {way} by its {len(checks)} check lengths: "
        "a scale bar is not as long as stated, or the check lengths are not"
    )
    nothing = (float("nan"), float("nan"))
    reported: dict[str, object] = {"ppm": ppm}
    found = ImageFinding(SCALE_ERROR, "station", None, reported, {"ppm": 1e6 * sigma}, p_value, (), nothing, text)
    return (found,)


def _common_scale(error: Array, length: Array, covariance: Array) -> tuple[float, float, float]:
    """Scale (1) that explains errors (k,) of lengths (k,), its sigma, and the chi-square of what it leaves."""
    weighted = np.linalg.solve(covariance, np.stack([length, error], axis=1))
    precision = float(length @ weighted[:, 0])
    scale = float(length @ weighted[:, 1]) / precision
    rest = error - scale * length
    return scale, precision**-0.5, float(rest @ np.linalg.solve(covariance, rest))

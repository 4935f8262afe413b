"""A diagnosis as the content of diagnosis.json (`robcal/diagnosis-1`): plain numbers, millimetres and degrees."""

import math
from collections.abc import Sequence

from robcal.diagnosis.core.result import Diagnosis, Finding
from robcal.diagnosis.images.diagnosis import ImageDiagnosis, ImageFinding
from robcal.diagnosis.next_poses import poses_table
from robcal.photogrammetry.measure.measured_points import Exchange
from robcal.photogrammetry.station.contradictions import TARGET_SWAPPED
from robcal.physics.library import kinds


def diagnosis_content(diagnosis: Diagnosis) -> dict[str, object]:
    """The content of diagnosis.json for a robot's recording."""
    first = diagnosis.findings[0] if diagnosis.findings else None
    location = (
        None
        if first is None
        else {
            "stage": first.cause.stage,
            "where": first.cause.where,
            "direction": first.cause.direction,
            "poses": list(first.poses),
        }
    )
    return {
        "format": "robcal/diagnosis-1",
        "mismatch": diagnosis.mismatch,
        "p_value": number(diagnosis.p_value),
        "statement": summary(diagnosis),
        "location": location,
        "causes": [cause_content(finding) for finding in diagnosis.findings],
        "heldout_mm": {
            "before": number(diagnosis.heldout[0] * 1e3),
            "after": number(diagnosis.heldout[1] * 1e3),
            "noise_floor": number(diagnosis.heldout[2] * 1e3),
            "kind": diagnosis.heldout_kind,
            "region": None
            if diagnosis.region is None
            else dict(zip(("before", "after"), (number(v * 1e3) for v in diagnosis.region), strict=True)),
        },
        "noise": {
            "stated": 1.0,
            "estimated": number(diagnosis.noise_estimated),
            "joint_repeatability_deg": number(math.degrees(diagnosis.joint_sigma)),
        },
        "unexplained": {
            "p_value": number(diagnosis.unexplained_p),
            "pattern": diagnosis.unexplained_pattern,
            # beyond the measuring noise: repeatability of the joints, and whatever no term of the model follows
            "rms_mm": number(1e3 * math.sqrt(max(diagnosis.heldout[1] ** 2 - diagnosis.heldout[2] ** 2, 0.0))),
        },
        "blunders": list(diagnosis.blunders),
        "next_poses": poses_table(diagnosis.next_poses, diagnosis.model),
        "notes": list(diagnosis.notes),
        "seconds": number(diagnosis.seconds),
    }


def cause_content(finding: Finding) -> dict[str, object]:
    """One of the causes in diagnosis.json."""
    cause = finding.cause
    return {
        "cause": cause.name,
        "stage": cause.stage,
        "where": cause.where,
        "direction": cause.direction,
        "parameters": {name: number(value) for name, value in finding.parameters.items()},
        "sigma": {name: number(value) for name, value in finding.sigma.items()},
        "p_value": number(finding.p_value),
        "log_evidence": number(finding.log_evidence),
        "indistinguishable_from": [
            {
                "cause": rival.cause.name,
                "where": rival.cause.where,
                "direction": rival.cause.direction,
                "probability": number(rival.probability),
                "overlap": number(rival.overlap),
            }
            for rival in finding.rivals
        ],
        "explained": number(finding.explained),
        "poses": list(finding.poses),
        "heldout_mm": {"before": number(finding.heldout[0] * 1e3), "after": number(finding.heldout[1] * 1e3)},
        "in_force": not finding.waits,
        "in_force_reason": finding.waits,
        "statement": finding.full_statement,
    }


def with_exchanges(
    content: dict[str, object], exchanges: Sequence[Exchange], names: Sequence[str]
) -> dict[str, object]:
    """The content of diagnosis.json with targets that carried each other's number in some poses, first of its causes.

    ``names`` of all poses. The test is that of signs: every length fits the exchanged numbers better than its own,
    which chance does in half of them; four lengths a pose at least were judged. What the robot gains is not counted:
    the points were used with their right numbers from the start.
    """
    if not exchanges:
        return content
    causes = [_exchange_cause(x, [names[p] for p in x.poses]) for x in exchanges]
    statement = "; ".join(str(cause["statement"]) for cause in causes)
    rest = f"; {content['statement']}" if content["causes"] else ""
    first = causes[0]
    location = {key: first[key] for key in ("stage", "where", "direction", "poses")}
    return content | {
        "mismatch": True,
        "p_value": first["p_value"],
        "location": content["location"] or location,
        "statement": statement + rest,
        "causes": [*causes, *_listed(content["causes"])],
    }


def _exchange_cause(exchange: Exchange, poses: list[str]) -> dict[str, object]:
    where, other = (str(t) for t in exchange.targets)
    return {
        "cause": TARGET_SWAPPED.name,
        "stage": TARGET_SWAPPED.stage,
        "where": where,
        "direction": None,
        "parameters": {"with": exchange.targets[1]},
        "sigma": {},
        "p_value": 0.5 ** (4 * len(poses)),
        "log_evidence": None,
        "indistinguishable_from": [],
        "explained": None,
        "poses": poses,
        "heldout_mm": {"before": None, "after": None},
        "statement": f"targets {where} and {other} carry each other's number in {len(poses)} pose(s): lengths on the "
        f"body miss by {1e3 * exchange.before:.3g} mm as recorded, by {1e3 * exchange.after:.2g} mm exchanged",
    }


def image_cause(finding: ImageFinding) -> dict[str, object]:
    """One cause found in images, as in diagnosis.json."""
    return {
        "cause": finding.name,
        "stage": finding.stage,
        "where": finding.where,
        "direction": finding.direction,
        "parameters": {name: number(value) for name, value in finding.parameters.items()},
        "sigma": {name: number(value) for name, value in finding.sigma.items()},
        "p_value": number(finding.p_value),
        "indistinguishable_from": [{"cause": kind.name, "where": where} for kind, where in finding.rivals],
        "heldout_px": {"before": number(finding.heldout_px[0]), "after": number(finding.heldout_px[1])},
        "statement": finding.statement,
    }


def with_images(
    robot: dict[str, object] | None, findings: Sequence[ImageFinding], scans: Sequence[ImageDiagnosis], noise: float
) -> dict[str, object]:
    """The content of diagnosis.json for images alone, or the robot's extended by what the images say first.

    `findings` are in the order in which they were accepted; `scans` the last scans of each set of images; `noise` the
    factor by which the marks scatter more than stated.
    """
    causes = [image_cause(finding) for finding in findings]
    if robot is not None:
        if not causes:
            return robot
        first = findings[0]
        statements = ". ".join(finding.statement for finding in findings) + "."
        text = (
            f"{statements} {robot['statement']}"
            if robot["mismatch"]
            else f"{statements} Beyond that nothing is missing."
        )
        return robot | {
            "mismatch": True,
            "p_value": number(min(first.p_value, float(str(robot["p_value"])))),
            "statement": text,
            "location": _place(first),
            "causes": [*causes, *_not_among(findings, _listed(robot["causes"]))],
        }
    values = [finding.heldout_px[0] for finding in findings if math.isfinite(finding.heldout_px[0])]
    before = max(values, default=max((s.heldout_px[0] for s in scans), default=0.0))
    after = max((scan.heldout_px[1] for scan in scans), default=0.0)
    floor = max((scan.heldout_px[2] for scan in scans), default=0.0)
    left = min((scan.unexplained_p for scan in scans), default=1.0)
    text = ". ".join(finding.statement for finding in findings) + "."
    return {
        "format": "robcal/diagnosis-1",
        "mismatch": bool(findings),
        "p_value": number(min((f.p_value for f in findings), default=min((s.p_value for s in scans), default=1.0))),
        "statement": text if findings else "Nothing is missing: the images agree with their model down to their noise.",
        "location": _place(findings[0]) if findings else None,
        "causes": causes,
        "heldout_px": {"before": number(before), "after": number(after), "noise_floor": number(floor)},
        "noise": {"stated": 1.0, "estimated": number(noise)},
        "unexplained": {
            "p_value": number(left),
            "pattern": None if left > 0.01 else "a smooth field over the image, small against the noise",
        },
        "blunders": [],
        "next_poses": [],
        "notes": [],
    }


def _place(finding: ImageFinding) -> dict[str, object]:
    return {"stage": finding.stage, "where": finding.where, "direction": finding.direction, "poses": []}


def _not_among(findings: Sequence[ImageFinding], causes: list[object]) -> list[object]:
    """Causes of the robot's recording that the images do not tell already (under one of their two numbers if swapped,
    and for the station as a whole if a camera moved)."""

    def place(cause: str, where: str, parameters: object) -> tuple[str, frozenset[str]]:
        others = {str(parameters["with"])} if isinstance(parameters, dict) and "with" in parameters else set()
        return cause, frozenset({"station" if kinds()[cause].of_station else where, *others})

    known = {place(f.name, f.where, f.parameters) for f in findings}
    return [
        cause
        for cause in causes
        if not isinstance(cause, dict)
        or place(str(cause["cause"]), str(cause["where"]), cause["parameters"]) not in known
    ]


def _listed(causes: object) -> list[object]:
    return list(causes) if isinstance(causes, list) else []


def summary(diagnosis: Diagnosis) -> str:
    """The one sentence for a person."""
    if not diagnosis.findings:
        if diagnosis.unexplained_pattern is not None:
            return (
                f"The model misses something (p = {diagnosis.unexplained_p:.2g}, {diagnosis.unexplained_pattern}), for "
                "which no cause of the library stands."
            )
        text = "Nothing is missing: the model explains the recording down to its noise"
        if diagnosis.noise_estimated > 1.15 or diagnosis.noise_estimated < 0.85:
            text += f" (the data scatter {diagnosis.noise_estimated:.2f} times what their covariance says)"
        return text + "."
    return ". ".join(_with_gain(finding, len(diagnosis.findings)) for finding in diagnosis.findings) + "."


def _with_gain(finding: Finding, count: int) -> str:
    """A statement with its share of the gain of all causes, or that poses kept out get no better by it."""
    before, after = finding.heldout
    if after >= before:
        return f"{finding.full_statement}; poses kept out get no better by it"
    share = f"; it is {finding.explained:.0%} of what all causes gain" if count > 1 else ""
    return f"{finding.full_statement}{share}"


def number(value: object) -> object:
    """Plain JSON numbers; what is not finite becomes null."""
    if isinstance(value, bool) or value is None or isinstance(value, (str, int, dict)):
        return value
    if isinstance(value, (list, tuple)):
        return [number(v) for v in value]
    numeric = float(value)  # type: ignore[arg-type]
    return numeric if math.isfinite(numeric) else None

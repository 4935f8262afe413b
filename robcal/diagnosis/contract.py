"""A diagnosis in the contract's form (`robcal/diagnosis-1`): plain numbers, millimetres and degrees."""

from __future__ import annotations

import math

from robcal.diagnosis.next_poses import poses_table
from robcal.diagnosis.result import Diagnosis, Finding


def as_contract(diagnosis: Diagnosis) -> dict[str, object]:
    """The content of diagnosis.json for a robot's recording."""
    first = diagnosis.findings[0] if diagnosis.findings else None
    location = None if first is None else {
        "stage": first.family.stage, "where": first.family.where, "direction": first.family.direction,
        "poses": list(first.poses),
    }
    return {
        "format": "robcal/diagnosis-1",
        "mismatch": diagnosis.mismatch,
        "p_value": number(diagnosis.p_value),
        "statement": summary(diagnosis),
        "location": location,
        "causes": [_cause(finding) for finding in diagnosis.findings],
        "heldout_mm": {
            "before": number(diagnosis.heldout[0] * 1e3), "after": number(diagnosis.heldout[1] * 1e3),
            "noise_floor": number(diagnosis.heldout[2] * 1e3), "kind": diagnosis.heldout_kind,
        },
        "noise": {
            "stated": 1.0, "estimated": number(diagnosis.noise_estimated),
            "joint_repeatability_deg": number(math.degrees(diagnosis.joint_sigma)),
        },
        "unexplained": {"p_value": number(diagnosis.unexplained_p), "pattern": diagnosis.unexplained_pattern},
        "blunders": list(diagnosis.blunders),
        "next_poses": poses_table(diagnosis.next_poses, diagnosis.model),
        "notes": list(diagnosis.notes),
        "seconds": number(diagnosis.seconds),
    }


def _cause(finding: Finding) -> dict[str, object]:
    family = finding.family
    return {
        "cause": family.cause, "stage": family.stage, "where": family.where, "direction": family.direction,
        "parameters": {name: number(value) for name, value in finding.parameters.items()},
        "sigma": {name: number(value) for name, value in finding.sigma.items()},
        "p_value": number(finding.p_value),
        "log_evidence": number(finding.log_evidence),
        "indistinguishable_from": [
            {
                "cause": rival.family.cause, "where": rival.family.where, "direction": rival.family.direction,
                "probability": number(rival.probability), "overlap": number(rival.overlap),
            }
            for rival in finding.rivals
        ],
        "explained": number(finding.explained),
        "poses": list(finding.poses),
        "heldout_mm": {"before": number(finding.heldout[0] * 1e3), "after": number(finding.heldout[1] * 1e3)},
        "statement": finding.statement,
    }


def summary(diagnosis: Diagnosis) -> str:
    """The one sentence for a person."""
    if not diagnosis.findings:
        text = "Nothing is missing: the model explains the recording down to its noise"
        if diagnosis.noise_estimated > 1.15 or diagnosis.noise_estimated < 0.85:
            text += f" (the data scatter {diagnosis.noise_estimated:.2f} times what their covariance says)"
        return text + "."
    parts = [f"{finding.statement}; it explains {finding.explained:.0%} of what was left" for finding in diagnosis.findings]
    return ". ".join(parts) + "."


def number(value: object) -> object:
    """Plain JSON numbers; what is not finite becomes null."""
    if isinstance(value, bool) or value is None or isinstance(value, (str, int, dict)):
        return value
    if isinstance(value, (list, tuple)):
        return [number(v) for v in value]
    numeric = float(value)  # type: ignore[arg-type]
    return numeric if math.isfinite(numeric) else None

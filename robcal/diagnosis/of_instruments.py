"""A diagnosis of several instruments as the content of diagnosis.json."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from robcal.diagnosis.content import cause_content, diagnosis_content, number
from robcal.diagnosis.core.result import Diagnosis, Finding


@dataclass(frozen=True)
class Attributed:
    """A finding, the instrument that shows it, and those that agree or contradict; ``stage`` where it belongs."""

    finding: Finding
    instrument: str
    agreeing: tuple[str, ...]
    contradicting: tuple[str, ...]
    stage: str
    statement: str


def instruments_content(
    own: Mapping[str, Diagnosis],
    causes: Sequence[Attributed],
    leading: str,
    heldout_mm: tuple[float, float] | None,
    not_told: Sequence[str],
) -> dict[str, object]:
    """The leading instrument's content, with the causes of all, and ``instruments`` : what each says by itself.

    ``heldout_mm`` : error at kept-out poses before and after, of the instrument that verifies.
    """
    content = diagnosis_content(own[leading])
    reported = [_cause(c) for c in causes]
    first = causes[0].finding if causes else None
    location = None
    if first is not None:
        location = {
            "stage": causes[0].stage,
            "where": first.cause.where,
            "direction": first.cause.direction,
            "poses": list(first.poses),
            "instrument": causes[0].instrument,
        }
    gain = dict(content["heldout_mm"]) if isinstance(content["heldout_mm"], dict) else {}
    if heldout_mm is not None:
        gain |= {"before": number(heldout_mm[0]), "after": number(heldout_mm[1])}
    left = min(own.values(), key=lambda d: d.unexplained_p)
    return content | {
        "mismatch": bool(causes),
        "p_value": number(min(d.p_value for d in own.values())),
        "statement": "; ".join(c.statement for c in causes) or "Nothing is missing: the model explains all instruments",
        "location": location,
        "causes": reported,
        "heldout_mm": gain,
        "unexplained": diagnosis_content(left)["unexplained"],
        "instruments": {name: _of_one(name, d, causes) for name, d in own.items()},
        "not_told": list(not_told),
    }


def _cause(c: Attributed) -> dict[str, object]:
    content = cause_content(c.finding)
    return content | {
        "stage": c.stage,
        "instrument": c.instrument,
        "agreeing": list(c.agreeing),
        "contradicting": list(c.contradicting),
        "statement": c.statement,
    }


def _of_one(name: str, diagnosis: Diagnosis, causes: Sequence[Attributed]) -> dict[str, object]:
    return {
        "mismatch": diagnosis.mismatch,
        "p_value": number(diagnosis.p_value),
        "causes": [
            {"cause": c.finding.cause.name, "where": c.finding.cause.where, "direction": c.finding.cause.direction}
            for c in causes
            if c.instrument == name
        ],
        "noise": {"stated": 1.0, "estimated": number(diagnosis.noise_estimated)},
        "blunders": list(diagnosis.blunders),
        "unexplained_p": number(diagnosis.unexplained_p),
    }

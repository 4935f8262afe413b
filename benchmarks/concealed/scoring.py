"""Scores of one answer against its truth, as flat records that can be stored and tabulated."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.concealed.adapter import Answer
from benchmarks.concealed.equivalence import Equivalence
from benchmarks.concealed.scenarios import Scenario
from fixtures.draws import OUTSIDE
from fixtures.effects import Effect
from fixtures.plan import Recording, Truth
from fixtures.signature import Design, oracle, recorded_noise, tip_error_mm

PERIODIC = {"phase_deg": 360.0, "azimuth_deg": 360.0}
NOT_COMPARED = {"pose", "order", "from", "with", "threshold_Nm", "tau_h", "covariate", "term", "torque_scale"}
NOT_COMPARED |= {"linear_deg_per_kNm"}  # drawn on top of the joint's own compliance, told as the whole


UP_TO_A_MOTION = frozenset({"base_moved", "camera_moved", "refraction"})
"""Effects whose recording leaves the world open: which of base and station moved, and, where the place of the
instrument is not given, the turn that a bend of its rays resembles. Errors count after the best rigid motion."""
VISIBLE = 3.0
"""A name for an effect outside the library is wrong if what it cannot reproduce has at least this SNR; a name that
reproduces the effect down to the noise is as good a model as the data can tell."""


def score(scenario: Scenario, recording: Recording, truth: Truth, answer: Answer) -> dict[str, Any]:
    """Everything that the tables need about one run."""
    design = Design.of(truth)
    equal = Equivalence(truth, design)
    record: dict[str, Any] = {
        "robot": truth.plan.robot,
        "seconds": answer.seconds,
        "mismatch": answer.mismatch,
        "p_value": answer.diagnosis.get("p_value"),
        "truth": [e.as_dict() for e in truth.effects],
        "answer": [_brief(c) for c in answer.causes],
        "unexplained_p": (answer.diagnosis.get("unexplained") or {}).get("p_value"),
        "noise_estimated": (answer.diagnosis.get("noise") or {}).get("estimated"),
    }
    if truth.effects:
        record |= _effects(scenario, truth, answer, equal)
        if truth.plan.level in ("points", "frames", "sensor"):
            record |= _gain(recording, truth, answer, design)
    return record


def _brief(cause: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "cause": cause["cause"],
        "stage": cause.get("stage"),
        "where": cause["where"],
        "direction": cause.get("direction"),
        "parameters": {k: v for k, v in (cause.get("parameters") or {}).items() if k != "term"},
        "rivals": [f"{r['cause']}@{r['where']}" for r in cause.get("indistinguishable_from") or []],
    }


def _effects(scenario: Scenario, truth: Truth, answer: Answer, equal: Equivalence) -> dict[str, Any]:
    unused = list(answer.causes)
    named = []
    for effect in truth.effects:
        hit = next((c for c in unused if equal.same(effect, c)), None)
        if hit is not None:
            unused.remove(hit)
        named.append(hit)
    out: dict[str, Any] = {"named": sum(n is not None for n in named), "extras": len(unused)}
    out["exact"] = out["named"] == len(truth.effects) and not unused
    first = answer.causes[0] if answer.causes else None
    if first is not None and len(truth.effects) == 1:
        out |= _first(truth.effects[0], first, equal)
    if scenario.together:
        everything = {c["cause"] for c in answer.causes} | {
            r["cause"] for c in answer.causes for r in c.get("indistinguishable_from") or []
        }
        out["told_together"] = all(name in everything for name in scenario.together)
    return out


def _first(effect: Effect, first: Mapping[str, Any], equal: Equivalence) -> dict[str, Any]:
    """Place and name of the first answer, its set, its parameters."""
    named = equal.same(effect, first)
    rivals = list(first.get("indistinguishable_from") or [])
    others = [r for r in rivals if not equal.same(effect, r)]
    here = str(first["where"]) == effect.where
    directions = {str(first.get("direction") or ""), effect.direction or ""}
    out: dict[str, Any] = {
        "name_right": named,
        "cosine": equal.cosine(effect, first) if first["cause"] != "unknown" else None,
        "unknown": first["cause"] == "unknown",
        "stage_right": named or first.get("stage") == effect.stage,
        "where_right": named or here,
        "direction_right": named or (here and ("" in directions or len(directions) == 1)),
        "set_covers": named or len(others) < len(rivals),
        "set_size": len(others) + (0 if named else 1) + (1 if named or len(others) < len(rivals) else 0),
    }
    if effect.cause in OUTSIDE and first["cause"] != "unknown":
        left = equal.design.snr([effect]) * float(np.sqrt(max(1.0 - out["cosine"] ** 2, 0.0)))
        out |= {"left_snr": left, "wrongly_named": left > VISIBLE}
    elif effect.cause in OUTSIDE:
        out["wrongly_named"] = False
    if first["cause"] == effect.cause and here:
        inside, total = _intervals(effect, first)
        out |= {"intervals_inside": inside, "intervals": total}
    return out


def _intervals(effect: Effect, first: Mapping[str, Any]) -> tuple[int, int]:
    """How many 95 % intervals hold the true value, of how many."""
    inside = total = 0
    for name, sigma in (first.get("sigma") or {}).items():
        if name in NOT_COMPARED or name not in effect.parameters or effect.cause in ("camera_moved", "sensor_rotation"):
            continue
        told, true = first["parameters"].get(name), effect.parameters[name]
        if told is None or sigma is None:
            continue
        for a, b, s in zip(np.atleast_1d(told), np.atleast_1d(true), np.atleast_1d(sigma), strict=False):
            difference = float(a) - float(b)
            if name in PERIODIC:
                difference = (difference + PERIODIC[name] / 2) % PERIODIC[name] - PERIODIC[name] / 2
            total += 1
            inside += abs(difference) <= 1.96 * float(s)
    return inside, total


def _gain(recording: Recording, truth: Truth, answer: Answer, design: Design) -> dict[str, Any]:
    """Errors on kept-out poses: of the fit without the effect, of the tool's prediction, of the true form's fit."""
    free_world = any(effect.cause in UP_TO_A_MOTION for effect in truth.effects)
    best = oracle(truth, recorded_noise(recording, truth), design, free_world=free_world)
    out: dict[str, Any] = {}
    for name, kept, before, after in (
        ("inside", truth.inside, best.before_inside, best.after_inside),
        ("outside", truth.outside, best.before_outside, best.after_outside),
    ):
        if name not in answer.predicted:
            continue
        out[f"before_{name}"], out[f"oracle_{name}"] = before, after
        out[f"after_{name}"] = tip_error_mm(answer.predicted[name], kept.with_effect, free_world=free_world)
    return out

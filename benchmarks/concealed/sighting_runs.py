"""Batteries at the level of marks: surveys and stations without robot, run by the commands."""

import tempfile
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.concealed.adapter import command
from fixtures.effects import Effect
from fixtures.sightings import STATION_CAUSES, SURVEY_CAUSES, make_sightings

SNRS = (6.0, 8.5, 12.0, 20.0)
NULLS: dict[str, dict[str, float]] = {
    "plain": {},
    "understated": {"stated_factor": 0.87},
    "overstated": {"stated_factor": 1.15},
    "single blunders": {"blunder_share": 0.002},
}


@dataclass(frozen=True)
class Sighting:
    """One campaign of marks: a survey or a station (``level``), a kind of noise or a cause (``label``)."""

    battery: str
    level: str
    label: str
    seed: int
    snr: float | None

    @property
    def key(self) -> str:
        """Unique name, also for resuming."""
        return f"{self.battery}/{self.label}/{self.level}/{self.seed}/{self.snr}"


def sightings(battery: str, count: int, seed: int, level: str) -> Iterator[Sighting]:
    """``nulls`` or ``singles`` of a level, ``survey`` or ``station``."""
    for i in range(count):
        if battery == "nulls":
            for label in NULLS:
                yield Sighting(battery, level, label, seed + i, None)
            continue
        for number, cause in enumerate(SURVEY_CAUSES if level == "survey" else STATION_CAUSES):
            for k, snr in enumerate(SNRS[:1] if cause == "target_swapped" else SNRS):
                yield Sighting(battery, level, cause, seed + 1000 * i + 10 * number + k, snr)


def run_sighting(sighting: Sighting) -> dict[str, Any]:
    """Make, run and score one campaign; a failure of the tool is a record with ``error``."""
    record: dict[str, Any] = {"key": sighting.key, "battery": sighting.battery, "label": sighting.label}
    record |= {"level": sighting.level, "snr": sighting.snr, "seed": sighting.seed, "robot": "none"}
    with tempfile.TemporaryDirectory(prefix="concealed-") as folder:
        root = Path(folder)
        plan = make_sightings(
            root / "campaign",
            seed=sighting.seed,
            kind=sighting.level,
            snr=sighting.snr,
            effects=[] if sighting.snr is None else [sighting.label],
            **NULLS.get(sighting.label, {}),
        )
        record["truth"] = [e.as_dict() for e in plan.effects]
        try:
            answer = command(root / "campaign", {})
        except Exception as error:
            return {**record, "error": f"{type(error).__name__}: {error}", "traceback": traceback.format_exc()[-1500:]}
    causes = answer.causes
    record |= {"seconds": answer.seconds, "mismatch": answer.mismatch, "p_value": answer.diagnosis.get("p_value")}
    record["answer"] = [
        {k: c.get(k) for k in ("cause", "stage", "where", "direction", "parameters", "sigma")} for c in causes
    ]
    if plan.effects:
        record |= _scores(plan.effects[0], causes)
    return record


def _scores(effect: Effect, causes: list[Any]) -> dict[str, Any]:
    right = [c for c in causes if _is(effect, c)]
    out: dict[str, Any] = {"exact": len(causes) == len(right) == 1, "extras": len(causes) - len(right)}
    out["named"] = len(right)
    if not causes:
        return out
    first = causes[0]
    rivals = list(first.get("indistinguishable_from") or [])
    covered = _is(effect, first) or any(_is(effect, r) for r in rivals)
    same_place = str(first["where"]) == effect.where or _is(effect, first)
    out |= {"name_right": _is(effect, first), "stage_right": first.get("stage") == effect.stage}
    out |= {"where_right": same_place, "direction_right": same_place}
    return out | {"set_covers": covered, "set_size": 1 + len(rivals)}


def _is(effect: Effect, told: Any) -> bool:
    if told["cause"] != effect.cause:
        return False
    if effect.cause == "target_swapped":  # either of the two may be named first
        return str(told["where"]) in (effect.where, str(effect.parameters["with"]))
    return str(told["where"]) == effect.where

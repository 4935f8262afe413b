"""Batteries of robots with their own station, at the level of marks, through the stages of ``pipeline run``."""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.concealed.own_scoring import diagnosed
from fixtures.draws import NotDrawable
from fixtures.own_effects import draw_own_effect
from fixtures.own_files import make_own
from fixtures.own_station import OWN_BODY_CAUSES, OWN_CAMERA_CAUSES, OWN_ROBOT_CAUSES, OwnPlan

SNRS = (8.5, 15.0)
NULLS: dict[str, dict[str, float]] = {
    "plain": {},
    "repeatability": {"joint_repeatability_rad": 15e-6},
    "understated": {"stated_factor": 0.85},
    "overstated": {"stated_factor": 1.15},
    "single blunders": {"blunder_share": 0.003},
}
ROBOTS = ("kr150", "kr150", "ur10", "irb120")


@dataclass(frozen=True)
class Own:
    """One campaign of robot and station; ``label`` is a kind of noise or a cause."""

    battery: str
    label: str
    seed: int
    snr: float | None
    level: str = "own"

    @property
    def key(self) -> str:
        """Unique name, also for resuming."""
        return f"{self.battery}/{self.label}/{self.level}/{self.seed}/{self.snr}"

    @property
    def plan(self) -> dict[str, Any]:
        """Fields of the plan: robots, numbers of cameras and targets take turns."""
        cameras, targets = ((2, 5), (2, 9), (3, 5), (2, 5))[self.seed // 4 % 4]
        return {"seed": self.seed, "robot": ROBOTS[self.seed % 4], "cameras": cameras, "targets": targets}


def own_runs(battery: str, count: int, seed: int) -> Iterator[Own]:
    """``nulls`` or ``singles``."""
    for i in range(count):
        if battery == "nulls":
            for k, label in enumerate(NULLS):
                yield Own(battery, label, seed + 10 * i + k, None)
            continue
        causes = (*OWN_ROBOT_CAUSES, *OWN_CAMERA_CAUSES, *OWN_BODY_CAUSES)
        for number, cause in enumerate(causes):
            for k, snr in enumerate(SNRS[:1] if cause == "target_swapped" else SNRS):
                yield Own(battery, cause, seed + 1000 * i + 3 * number + k, snr)


def run_own(own: Own) -> dict[str, Any]:
    """Make, run and score one campaign; a failure of the tool is a record with ``error``."""
    record: dict[str, Any] = {"key": own.key, "battery": own.battery, "label": own.label, "level": own.level}
    record |= {"snr": own.snr, "seed": own.seed, "robot": own.plan["robot"]}
    with tempfile.TemporaryDirectory(prefix="concealed-") as folder:
        root = Path(folder)
        plan = own.plan | NULLS.get(own.label, {})
        try:
            effects = [] if own.snr is None else [draw_own_effect(OwnPlan(**plan), own.label, own.snr)]
        except NotDrawable as error:
            return {**record, "skipped": str(error)}
        return record | diagnosed(root, make_own(root / "campaign", effects=effects, **plan))

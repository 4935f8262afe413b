"""Batteries of scenarios: nulls, single causes, mixtures, effects outside the library, inseparable pairs, decoys."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from fixtures.campaigns import plan_of
from fixtures.draws import BY_LEVEL, NARROWING, OUTSIDE, NotDrawable, draw_effect
from fixtures.effects import Effect
from fixtures.plan import Noise, Plan
from fixtures.recordings import draw_truth
from fixtures.signature import Design

SNR_CLASSES = (5.0, 6.0, 7.5, 8.5, 12.0, 20.0)
ROBOTS = ("kr150", "kr150", "ur10", "irb120")
URAD = 1e-6


@dataclass(frozen=True)
class Scenario:
    """One campaign to be made: its battery, a label within it, the plan, the SNR aimed at (None for nulls).

    ``together``: causes of which the tool has to say that it cannot tell them apart (inseparable pairs).
    """

    battery: str
    label: str
    plan: Plan
    snr: float | None = None
    together: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """Unique name, also for resuming."""
        return f"{self.battery}/{self.label}/{self.plan.level}/{self.plan.robot}/{self.plan.seed}/{self.snr}"


def _plan(seed: int, level: str, robot: str | None = None, noise: Noise | None = None) -> Plan:
    chosen = robot or ROBOTS[seed % len(ROBOTS)]
    if level == "distances":
        return plan_of(seed=seed, robot="kr150", level=level, poses=240, verify=40, model="table5.4", noise=noise)
    if level == "sensor":
        return plan_of(seed=seed, robot="kr150", level=level, poses=160, verify=30, noise=noise or Noise(0.03))
    return plan_of(seed=seed, robot=chosen, level=level, noise=noise or noise_of(chosen))


def noise_of(robot: str) -> Noise:
    """Measuring noise that goes with the size of a robot."""
    return Noise(0.06, 0.006) if robot == "kr150" else Noise(0.03, 0.004)


def nulls(count: int, seed: int, level: str) -> Iterator[Scenario]:
    """Nothing is missing; the noise is plain, has joint repeatability, heavy tails, is misstated, or has blunders."""
    for i in range(count):
        plan = _plan(seed + i, level)
        rng = np.random.default_rng([seed + i, 50])
        n = plan.noise
        understated, overstated = (float(rng.uniform(1.1, 1.2)) for _ in range(2))
        kinds = {
            "plain": n,
            "repeatability": replace(n, joint_repeatability_rad=20 * URAD),
            "heavy tails": replace(n, tails=5.0),
            "understated": replace(n, stated_factor=1.0 / understated),
            "overstated": replace(n, stated_factor=overstated),
        }
        if level == "points":
            kinds["single blunders"] = replace(n, blunder_share=0.004)
        for label, noise in kinds.items():
            yield Scenario("nulls", label, replace(plan, noise=noise))


def singles(count: int, seed: int, level: str) -> Iterator[Scenario]:
    """Every cause of the table that can show at the level, over classes of SNR."""
    for i in range(count):
        for number, cause in enumerate(BY_LEVEL[level]):
            for k, snr in enumerate(SNR_CLASSES):
                plan = _plan(seed + 1000 * i + 10 * number + k, level)
                if cause == "target_swapped" and k:
                    continue
                drawn = _drawn(plan, cause, snr)
                if drawn is not None:
                    yield Scenario("singles", cause, drawn, snr)


def outside(count: int, seed: int, level: str) -> Iterator[Scenario]:
    """Effects that the library has no name for."""
    for i in range(count):
        for number, cause in enumerate(OUTSIDE):
            for k, snr in enumerate((8.0, 12.0, 20.0)):
                drawn = _drawn(_plan(seed + 1000 * i + 10 * number + k, level), cause, snr)
                if drawn is not None:
                    yield Scenario("outside", cause, drawn, snr)


def mixtures(count: int, seed: int, level: str) -> Iterator[Scenario]:
    """Two or three causes at once that can be told apart (none lies within 0.95 of the span of the others)."""
    pool = [c for c in BY_LEVEL[level] if c not in NARROWING and c not in ("target_swapped", "camera_moved")]
    for i in range(count):
        for size in (2, 3):
            rng = np.random.default_rng([seed + i, 60, size])
            for _ in range(10):
                plan = _plan(seed + i, level)
                causes = [str(c) for c in rng.choice(pool, size, replace=False)]
                try:
                    for number, cause in enumerate(causes):
                        plan, effect = draw_effect(plan, cause, number=number, snr=float(rng.uniform(10, 25)))
                        plan = replace(plan, effects=(*plan.effects, effect))
                except NotDrawable:
                    continue
                if _separable(plan):
                    yield Scenario("mixtures", str(size), plan, None)
                    break


def inseparable(count: int, seed: int, level: str) -> Iterator[Scenario]:
    """Pairs whose signatures coincide on the recorded poses: the tool has to say so."""
    for i in range(count):
        plan = plan_of(seed=seed + i, robot="kr150", level=level)
        width = Effect("hysteresis", "axis1", None, {"width_deg": 0.02})
        lag = ("backlash", "hysteresis")
        yield Scenario(
            "inseparable", "lag of an unloaded axis", replace(plan, effects=(_scaled(plan, width, 12),)), 12, lag
        )
        moved = ("base_moved", "camera_moved")
        drawn = _drawn(plan, "base_moved", 15.0)
        if drawn is not None:
            yield Scenario("inseparable", "base or station moved", drawn, 15.0, moved)
        short = replace(plan, axis_ranges={"axis2": 0.25})
        ratio = Effect("transmission_ratio", "axis2", None, {"ratio_error_ppm": 500.0})
        yield Scenario(
            "inseparable",
            "axis 2 on a short range",
            replace(short, effects=(_scaled(short, ratio, 10),)),
            10,
            ("transmission_ratio", "joint_eccentricity"),
        )
        wave = {"order": 1, "amplitude_deg": 0.01, "phase_deg": 35.0}
        one_load = replace(plan, payloads=("dumbbell",))
        eccentric = Effect("joint_eccentricity", "axis2", None, wave)
        yield Scenario(
            "inseparable",
            "eccentricity or balancing torque",
            replace(one_load, effects=(_scaled(one_load, eccentric, 12),)),
            12,
            ("joint_eccentricity", "counterbalance"),
        )


def decoys(count: int, seed: int, level: str) -> Iterator[Scenario]:
    """True causes whose variable is tied to that of a false one, and single gross errors that are no cause."""
    for i in range(count):
        base = _plan(seed + i, level)
        sorted_poses = replace(base, order="axis1")
        yield from _decoy(
            "poses sorted by axis 1",
            sorted_poses,
            Effect("joint_eccentricity", "axis1", None, {"order": 2, "amplitude_deg": 0.01, "phase_deg": 20.0}),
            12.0,
        )
        tied = replace(base, approach="angle")
        yield from _decoy(
            "approach tied to the angle",
            tied,
            Effect("joint_eccentricity", "axis3", None, {"order": 2, "amplitude_deg": 0.01, "phase_deg": -50.0}),
            12.0,
        )
        if level == "points":
            yield Scenario(
                "decoys", "one bad target in a few poses", replace(base, noise=replace(base.noise, blunder_share=0.01))
            )


def _decoy(label: str, plan: Plan, effect: Effect, snr: float) -> Iterator[Scenario]:
    scaled = _scaled(plan, effect, snr)
    yield Scenario("decoys", label, replace(plan, effects=(scaled,)), snr)


def _scaled(plan: Plan, effect: Effect, snr: float) -> Effect:
    design = Design.of(draw_truth(plan))
    for _ in range(4):
        effect = effect.scaled(snr / design.snr([effect]))
    return effect


def _drawn(plan: Plan, cause: str, snr: float) -> Plan | None:
    try:
        plan, effect = draw_effect(plan, cause, snr=snr)
    except NotDrawable:
        return None
    return replace(plan, effects=(effect,))


def _separable(plan: Plan) -> bool:
    design = Design.of(draw_truth(plan))
    signatures = np.stack([design.project(design.signature([e])) for e in plan.effects], axis=1)
    unit = signatures / np.linalg.norm(signatures, axis=0)
    for k in range(unit.shape[1]):
        others = np.delete(unit, k, axis=1)
        left = unit[:, k] - others @ np.linalg.lstsq(others, unit[:, k], rcond=None)[0]
        if np.linalg.norm(left) < np.sqrt(1 - 0.7**2):
            return False
    return True


BATTERIES: dict[str, Callable[[int, int, str], Iterator[Scenario]]] = {
    "nulls": nulls,
    "singles": singles,
    "outside": outside,
    "mixtures": mixtures,
    "inseparable": inseparable,
    "decoys": decoys,
}

"""Batteries of scenarios: nulls, single causes, mixtures, effects outside the library, inseparable pairs, decoys."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

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
    """One campaign to be made.

    ``build`` makes its plan when it is needed (None where the effect cannot show in it). ``snr`` is what is aimed at
    (None for nulls and mixtures). ``together``: causes of which the tool has to say that it cannot tell them apart.
    ``follow``: the poses that the tool proposes are driven, and it is asked again.
    """

    battery: str
    label: str
    level: str
    seed: int
    snr: float | None
    build: Callable[[], Plan | None]
    together: tuple[str, ...] = ()
    follow: bool = False

    @property
    def key(self) -> str:
        """Unique name, also for resuming."""
        return f"{self.battery}/{self.label}/{self.level}/{self.seed}/{self.snr}"


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
    kinds = ["plain", "repeatability", "heavy tails", "understated", "overstated"]
    for i in range(count):
        for label in [*kinds, *(["single blunders"] if level == "points" else [])]:
            yield Scenario("nulls", label, level, seed + i, None, partial(_null, seed + i, level, label))


def _null(seed: int, level: str, label: str) -> Plan:
    plan = _plan(seed, level)
    off = float(np.random.default_rng([seed, 50]).uniform(1.1, 1.2))
    changes: dict[str, dict[str, float]] = {
        "plain": {},
        "repeatability": {"joint_repeatability_rad": 20 * URAD},
        "heavy tails": {"tails": 5.0},
        "understated": {"stated_factor": 1.0 / off},
        "overstated": {"stated_factor": off},
        "single blunders": {"blunder_share": 0.004},
    }
    return replace(plan, noise=replace(plan.noise, **changes[label]))


def singles(count: int, seed: int, level: str) -> Iterator[Scenario]:
    """Every cause of the table that can show at the level, over classes of SNR."""
    for i in range(count):
        for number, cause in enumerate(BY_LEVEL[level]):
            for k, snr in enumerate(SNR_CLASSES):
                if cause == "target_swapped" and k:
                    continue
                own = seed + 1000 * i + 10 * number + k
                yield Scenario("singles", cause, level, own, snr, partial(_single, own, level, cause, snr))


def outside(count: int, seed: int, level: str) -> Iterator[Scenario]:
    """Effects that the library has no name for."""
    for i in range(count):
        for number, cause in enumerate(OUTSIDE):
            for k, snr in enumerate((8.0, 12.0, 20.0)):
                own = seed + 1000 * i + 10 * number + k
                yield Scenario("outside", cause, level, own, snr, partial(_single, own, level, cause, snr))


def _single(seed: int, level: str, cause: str, snr: float) -> Plan | None:
    return _drawn(_plan(seed, level), cause, snr)


def mixtures(count: int, seed: int, level: str) -> Iterator[Scenario]:
    """Two or three causes at once that can be told apart (none lies within 0.7 of the span of the others)."""
    for i in range(count):
        for size in (2, 3):
            yield Scenario("mixtures", str(size), level, seed + i, None, partial(_mixture, seed + i, level, size))


def _mixture(seed: int, level: str, size: int) -> Plan | None:
    pool = [c for c in BY_LEVEL[level] if c not in NARROWING and c not in ("target_swapped", "camera_moved")]
    rng = np.random.default_rng([seed, 60, size])
    for _ in range(10):
        plan = _plan(seed, level)
        try:
            for number, cause in enumerate(str(c) for c in rng.choice(pool, size, replace=False)):
                plan, effect = draw_effect(plan, cause, number=number, snr=float(rng.uniform(10, 25)))
                plan = replace(plan, effects=(*plan.effects, effect))
        except NotDrawable:
            continue
        if _separable(plan):
            return plan
    return None


def inseparable(count: int, seed: int, level: str) -> Iterator[Scenario]:
    """Pairs whose signatures coincide on the recorded poses: the tool has to say so."""
    wave = {"order": 1, "amplitude_deg": 0.01, "phase_deg": 35.0}
    for i in range(count):
        own = seed + i
        plan = partial(plan_of, seed=own, robot="kr150", level=level)
        lag = Effect("hysteresis", "axis1", None, {"width_deg": 0.02})
        ratio = Effect("transmission_ratio", "axis2", None, {"ratio_error_ppm": 500.0})
        eccentric = Effect("joint_eccentricity", "axis2", None, wave)
        yield Scenario(
            "inseparable",
            "lag of an unloaded axis",
            level,
            own,
            12.0,
            partial(_sized, plan, lag, 12.0),
            ("backlash", "hysteresis"),
        )
        yield Scenario(
            "inseparable",
            "base or station moved",
            level,
            own,
            15.0,
            partial(_single, own, level, "base_moved", 15.0),
            ("base_moved", "camera_moved"),
        )
        yield Scenario(
            "inseparable",
            "axis 2 on a short range",
            level,
            own,
            10.0,
            partial(_sized, partial(plan, axis_ranges={"axis2": 0.25}), ratio, 10.0),
            ("transmission_ratio", "joint_eccentricity"),
            follow=True,
        )
        yield Scenario(
            "inseparable",
            "eccentricity or balancing torque",
            level,
            own,
            12.0,
            partial(_sized, partial(plan, payloads=("dumbbell",)), eccentric, 12.0),
            ("joint_eccentricity", "counterbalance"),
        )


def decoys(count: int, seed: int, level: str) -> Iterator[Scenario]:
    """True causes whose variable is tied to that of a false one, and single gross errors that are no cause."""
    for i in range(count):
        own = seed + i
        by_order = Effect("joint_eccentricity", "axis1", None, {"order": 2, "amplitude_deg": 0.01, "phase_deg": 20.0})
        by_angle = Effect("joint_eccentricity", "axis3", None, {"order": 2, "amplitude_deg": 0.01, "phase_deg": -50.0})
        for label, effect, change in (
            ("poses sorted by axis 1", by_order, {"order": "axis1"}),
            ("approach tied to the angle", by_angle, {"approach": "angle"}),
        ):
            plan = partial(_changed, own, level, change)
            yield Scenario("decoys", label, level, own, 12.0, partial(_sized, plan, effect, 12.0))
        if level == "points":
            yield Scenario("decoys", "a bad target in a few poses", level, own, None, partial(_blunders, own, level))


def _changed(seed: int, level: str, change: dict[str, str]) -> Plan:
    return replace(_plan(seed, level), **change)  # type: ignore[arg-type]


def _blunders(seed: int, level: str) -> Plan:
    plan = _plan(seed, level)
    return replace(plan, noise=replace(plan.noise, blunder_share=0.01))


def _sized(make: Callable[[], Plan], effect: Effect, snr: float) -> Plan:
    plan = make()
    return replace(plan, effects=(_scaled(plan, effect, snr),))


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

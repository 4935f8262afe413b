"""Drift of a warming robot, uncorrected and corrected: a test of six hours, seven months of production, alarms.

Truth: `fixtures.warming`, temperatures distributed over gears and castings, none of it a parameter of the model.

    python -m benchmarks.drift            # all tables (about three minutes)
    python -m benchmarks.drift --only hours | months | alarms
"""

import argparse
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from fixtures.aiming import aimed_poses
from fixtures.measuring import SPHERE
from fixtures.rigid import frame_from_six, inverse
from fixtures.true_robot import TrueRobot
from fixtures.warming import Heat, Warming, sag_of, seen, warm, warm_tool
from robcal.calibration.calibrated import CalibratedRobot
from robcal.drift.control import DriftControl, Events, started
from robcal.drift.reference import DriftReference, Readings, freeze
from robcal.files.robot_file import read_robot
from robcal.robot.compensation import CompensationSettings, compensate
from robcal.robot.kernel_cache import kernel_of
from robcal.transforms import Array, transform

ROBOT = Path(__file__).parents[1] / "configs" / "robots" / "kr150_class.yaml"
SIGMA = 1.5e-5
REPEAT = np.radians(3e-4)
"""The robot's own repeatability: scatter of a joint, rad."""
COMPLIANCE = {"axis2.elastic_pitch": 2e-7, "axis3.elastic_pitch": 3e-7, "axis5.elastic_pitch": 6e-7}


class Cell:
    """A true robot in front of a sphere, and what a calibration left wrong of it."""

    def __init__(self, seed: int, poses: int, scale: float = 1.0) -> None:
        rng = self.rng = np.random.default_rng(seed)
        description = yaml.safe_load(ROBOT.read_text())
        world_T_base = inverse(frame_from_six([1.3, 0.1, 0.7, *rng.normal(0, 0.2, 3)]))
        flange_T_tool = frame_from_six([0.05, 0.0, 0.3, *rng.normal(0, 0.2, 3)])
        self.true = TrueRobot(
            description,
            COMPLIANCE,
            world_T_base=world_T_base,
            flange_T_tool=flange_T_tool,
            payloads={"load": (125.0, [0.0, 0.0, 0.2])},
        )
        self.q, self.target = aimed_poses(self.true, SPHERE, poses, rng)
        model = replace(
            read_robot(ROBOT),
            world_T_base=world_T_base,
            flange_T_tool=flange_T_tool,
            parameters={n: v * 0.95 for n, v in COMPLIANCE.items()},
        )
        # a calibration is never perfect: lengths are off by 0.05 mm, zeros by 0.002 deg
        wrong = {f"axis{k}.x": rng.normal(0, 5e-5) for k in (2, 3)}
        wrong |= {f"axis{k}.pitch": rng.normal(0, np.radians(2e-3)) for k in (2, 3, 5)}
        self.robot = CalibratedRobot(model=replace(model, parameters={**model.parameters, **wrong}), nominal=model)
        self.kernel = kernel_of(self.robot.model)
        self.warming = Warming.drawn(self.true, rng, scale)
        self.sag = sag_of(self.true, self.q)

    def heat(self, time_s: Array, work: Array) -> Heat:
        """Temperatures over time."""
        return warm(time_s, work, self.true.joints, len(self.true.names), self.rng)

    def tour(self, deviation: Array, cycle: int, at: float, q: Array, push: Array, slip: Array) -> Readings:
        """What the sensor sees: ``deviation`` (F, 9) of the robot at that instant."""
        n = len(q)
        moved = q + slip + REPEAT * self.rng.standard_normal(q.shape)
        T = warm_tool(self.true, moved, np.broadcast_to(deviation, (n, *deviation.shape)), None, self.sag)
        x = seen(T, SPHERE[self.target] + push, SIGMA, self.rng)
        covariance = np.broadcast_to((2 * SIGMA) ** 2 * np.eye(3), (n, 3, 3))
        names = tuple(f"p{i}" for i in range(n))
        return Readings(
            np.full(n, cycle), at + 3.0 * np.arange(n), names, self.target + 1, x, covariance, self.kernel.poses(q)
        )

    def corrected(self, reference: DriftReference, change: Array) -> Array:
        """Commands that bring the drifted robot's sensor where the reference had it, by one step to first order."""
        wanted = self.kernel.frames(self.kernel.theta0, self.kernel.poses(self.q))
        drifted = reference.theta(change)
        model = dict(self.robot.model.parameters)
        model.update(dict(zip(reference.names, drifted[reference.columns].tolist(), strict=True)))
        robot = kernel_of(replace(self.robot.model, parameters=model))
        return compensate(robot, wanted, near=self.q, settings=CompensationSettings(iterations=5)).require().q


def six_hours(seed: int, poses: int = 40) -> dict[str, float]:
    """Figure 6.7: from cold to 45 C in six hours, a tour every five minutes, commands compensated."""
    cell = Cell(seed, poses)
    time_s = np.arange(0, 6 * 3600 + 1, 300.0)
    heat = cell.heat(time_s, np.ones(len(time_s)))
    none, still = np.zeros(3), np.zeros(6)
    deviations = cell.warming.deviations(cell.true, heat, np.arange(len(time_s)))
    reference_tour = cell.tour(deviations[0], 0, 0.0, cell.q, none, still)
    reference = freeze(cell.robot, reference_tour)
    control = DriftControl(reference, started(reference, reference_tour))
    far = workspace(cell)
    before, after, wide_before, wide_after, seconds = [], [], [], [], []
    load = [None] * len(far)
    cold = warm_tool(cell.true, far, np.zeros((len(far), *deviations[0].shape)))
    modelled_cold = cell.kernel.frames(cell.kernel.theta0, cell.kernel.poses(far, load))
    for k in range(1, len(time_s)):
        q = cell.corrected(reference, control.state.model.change)
        tour = cell.tour(deviations[k], k, time_s[k], q, none, still)
        clock = time.process_time()
        events = control.take(tour, range(poses))
        seconds.append(time.process_time() - clock)
        T = warm_tool(cell.true, cell.q, np.broadcast_to(deviations[k], (poses, *deviations[k].shape)), None, cell.sag)
        away = transform(T, transform(inverse(frozen(cell, deviations[0])), SPHERE[cell.target]))
        before.append(float(np.linalg.norm(away - SPHERE[cell.target], axis=1).mean()))
        after.append(events.tours[0].corrected)
        now = warm_tool(cell.true, far, np.broadcast_to(deviations[k], (len(far), *deviations[k].shape)))
        model = cell.kernel.frames(reference.theta(control.state.model.change), cell.kernel.poses(far, load))
        drift = now[:, :3, 3] - cold[:, :3, 3]
        explained = model[:, :3, 3] - modelled_cold[:, :3, 3]
        wide_before.append(float(np.linalg.norm(drift, axis=1).mean()))
        wide_after.append(float(np.linalg.norm(drift - explained, axis=1).mean()))
    return {
        "uncorrected at the end": 1e3 * before[-1],
        "corrected, mean": 1e3 * float(np.mean(after)),
        "workspace, uncorrected": 1e3 * wide_before[-1],
        "workspace, corrected": 1e3 * wide_after[-1],
        "parameters": len(reference.names),
        "tour ms": 1e3 * float(np.median(seconds)),
    }


def frozen(cell: Cell, deviation: Array) -> Array:
    """True sensor frames of the reference."""
    return warm_tool(cell.true, cell.q, np.broadcast_to(deviation, (len(cell.q), *deviation.shape)), None, cell.sag)


def workspace(cell: Cell, count: int = 300) -> Array:
    """Joint angles anywhere within 60 per cent of the ranges."""
    low, high = cell.true.limits[:, 0], cell.true.limits[:, 1]
    low, high = np.maximum(low, -np.pi), np.minimum(high, np.pi)
    middle, half = (low + high) / 2, 0.6 * (high - low) / 2
    return np.random.default_rng(9).uniform(middle - half, middle + half, (count, 6))


def production(tours: int, rng: np.random.Generator, minutes: float = 14.0) -> tuple[Array, Array]:
    """Times (s) and work of tours: two shifts, weekends off, four holidays, pauses of all lengths."""
    time_s, work, t = [], [], 0.0
    holidays = {60: 9, 120: 3, 175: 4, 180: 2}
    while len(time_s) < tours:
        day, hour = int(t // 86400), (t % 86400) / 3600
        off = day % 7 == 6 or any(d <= day < d + n for d, n in holidays.items())
        if off or hour > 22.5:
            t = 86400.0 * (day + 1) + (0 if not off else 3600 * 5)
            continue
        if rng.random() < 0.004:
            t += rng.uniform(1800, 7200)
        time_s.append(t)
        work.append(rng.uniform(0.75, 1.0))
        t += 60 * minutes * rng.uniform(0.9, 1.1) * 0.9
    return np.array(time_s), np.array(work)


def idle_aware(cell: Cell, time_s: Array, work: Array) -> Array:
    """Deviations (t, F, 9) at the tours; while the robot stands its gears give off no heat."""
    fine, power, at = [], [], []
    for k, t in enumerate(time_s):
        gap = t - (time_s[k - 1] if k else t)
        if gap > 1500:  # the heat of a pause follows its own steps
            steps = np.linspace(time_s[k - 1], t, 12)[1:]
            fine += steps.tolist()
            power += [0.0] * len(steps)
        else:
            fine.append(t)
            power.append(work[k])
        at.append(len(fine) - 1)
    heat = cell.heat(np.array(fine), np.array(power))
    return cell.warming.deviations(cell.true, heat, np.array(at))


def seven_months(seed: int, tours: int, poses: int = 20) -> tuple[dict[str, float], Counter[str]]:
    """Figure 6.8: calibrations of seven months, replayed."""
    cell = Cell(seed, poses)
    time_s, work = production(tours, cell.rng)
    deviations = idle_aware(cell, time_s, work)
    none, still = np.zeros(3), np.zeros(6)
    # the reference is taken warm, as in production
    warm_row = min(200, tours - 1)
    readings = cell.tour(deviations[warm_row], -1, time_s[0] - 86400.0, cell.q, none, still)
    reference = freeze(cell.robot, readings)
    control = DriftControl(reference, started(reference, readings))
    corrected, alarms, seconds = [], Counter[str](), 0.0
    for k in range(tours):
        tour = cell.tour(deviations[k], k, time_s[k], cell.q, none, still)
        clock = time.process_time()
        events = control.take(tour, range(poses))
        seconds += time.process_time() - clock
        corrected += [t.corrected for t in events.tours]
        for alarm in events.alarms:
            alarms[alarm.kind] += 1
            if alarm.kind == "jump":
                print(f"    tour {k}: {alarm.text}")
    values = 1e3 * np.array(corrected)
    row = {
        "tours": float(tours),
        "days": float(time_s[-1] / 86400),
        "mean mm": float(values.mean()),
        "std mm": float(values.std()),
        "max mm": float(values.max()),
        "replay s": seconds,
        "tour ms": 1e3 * seconds / tours,
    }
    return row, alarms


def troubles(seeds: int) -> None:
    """A pushed sphere, a slipped joint, a dirty dot, in the middle of warming up: told within a tour?"""
    cases: dict[str, tuple[Array, Array, float]] = {"sphere 0.3 mm": (np.array([0.0003, 0, 0]), np.zeros(6), 0.0)}
    for joint in range(6):
        slip = np.zeros(6)
        slip[joint] = np.radians(0.02)
        cases[f"axis{joint + 1} 0.02 deg"] = (np.zeros(3), slip, 0.0)
    cases["dirty dot 0.3 mm"] = (np.zeros(3), np.zeros(6), 3e-4)
    told: Counter[str] = Counter()
    taken: Counter[str] = Counter()
    for seed in range(seeds):
        cell = Cell(seed, 30)
        time_s = np.arange(0, 3 * 3600 + 1, 600.0)
        deviations = cell.warming.deviations(cell.true, cell.heat(time_s, np.ones(len(time_s))), np.arange(len(time_s)))
        readings = cell.tour(deviations[0], 0, 0.0, cell.q, np.zeros(3), np.zeros(6))
        reference = freeze(cell.robot, readings)
        control = DriftControl(reference, started(reference, readings))
        for k in range(1, 8):
            control.take(cell.tour(deviations[k], k, time_s[k], cell.q, np.zeros(3), np.zeros(6)), range(30))
        for name, (push, slip, dirt) in cases.items():
            tried = DriftControl(reference, control.state)
            shifts = np.where((cell.target == cell.target[0])[:, None], [0.0, dirt, 0.0], 0.0) + push
            tour = cell.tour(deviations[8], 8, time_s[8], cell.q, shifts, slip)
            events: Events = tried.take(tour, range(30))
            kinds = {a.kind for a in events.alarms}
            told[name] += ("target" if dirt else "jump") in kinds
            taken[name] += events.tours[0].accepted and not dirt
    print(f"{'trouble':22}{'told':>8}{'compensated':>14}   of {seeds}")
    for name in cases:
        print(f"{name:22}{told[name]:8d}{taken[name]:14d}")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("hours", "months", "alarms"))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--tours", type=int, default=21000)
    options = parser.parse_args()
    if options.only in (None, "hours"):
        rows = [six_hours(seed) for seed in range(options.seeds)]
        print("six hours to 45 C, mm, mean and worst of the cells")
        for name in rows[0]:
            values = [row[name] for row in rows]
            print(f"  {name:26}{np.mean(values):9.3f}{np.max(values):9.3f}")
    if options.only in (None, "months"):
        row, alarms = seven_months(1, options.tours)
        print("seven months: " + ", ".join(f"{name} {value:.4g}" for name, value in row.items()))
        print(f"  alarms without trouble: {dict(alarms) or 'none'}")
    if options.only in (None, "alarms"):
        troubles(options.seeds)


if __name__ == "__main__":
    main()

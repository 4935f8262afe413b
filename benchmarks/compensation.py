"""Compensation: remaining error over the workspace after one step and after iteration, and time a pose in compiled C.

Run: ``python -m benchmarks.compensation [--poses 2000] [--seed 0]``. Robots are those of configs/robots with random
deviations of the usual size (0.4 mm, 0.6 mrad a frame, joint compliances 0.3 urad/(N m) in axis 1 to 3.3 in the last)
and a payload. Distances are those of the tool, 250 mm off the flange; "near a limit of the inverse" are poses whose
Jacobian's condition is below 0.02 (a wrist or elbow nearly stretched), given apart: one step is not enough there.
"""

import argparse
import shutil
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from robcal.files.robot_file import read_robot
from robcal.robot.chain import chain_of, forward
from robcal.robot.compensation import CompensationSettings, cell_frames, compensate
from robcal.robot.export.c_export import export_c
from robcal.robot.inverse import conditioning
from robcal.robot.kernel import Kernel
from robcal.robot.model import Payload, RobotModel
from robcal.transforms import Array, frame_from_xyzrpy

ROBOTS = {"kr150_class": 150.0, "irb120_like": 2.0, "ur10": 8.0, "scara_600": 3.0, "kr150_class_on_track": 150.0}
ROOT = Path(__file__).resolve().parents[1]


def real_robot(nominal: RobotModel, payload_kg: float, rng: np.random.Generator) -> RobotModel:
    """A robot as built: deviations, joint compliances, a payload, base and tool somewhere."""
    values = {}
    for f in nominal.frames:
        values |= {f"{f.name}.{k}": 0.4e-3 * rng.normal() for k in "xyz"}
        values |= {f"{f.name}.{k}": 0.6e-3 * rng.normal() for k in ("roll", "pitch", "yaw")}
    # the heavier loaded a joint, the stiffer it is built
    compliances = np.geomspace(0.3e-6, 3.3e-6, nominal.n_joints) * rng.uniform(0.8, 1.25, nominal.n_joints)
    for f, compliance in zip(nominal.joints, compliances, strict=True):
        if not f.prismatic:
            values[f"{f.name}.elastic_{f.joint_kind}"] = compliance
    return replace(
        nominal.with_parameters(values),
        payloads={"load": Payload(payload_kg, (0.02, 0.0, 0.15))},
        world_T_base=frame_from_xyzrpy([2.0, -1.0, 0.1, 0.0, 0.0, 0.7]),
        flange_T_tool=frame_from_xyzrpy([0.05, 0.0, 0.25, 0.0, 0.0, 0.0]),
    )


def workspace(model: RobotModel, count: int, rng: np.random.Generator) -> Array:
    """Joint values spread over the limits (at most one turn), 5 % away from them."""
    chain = chain_of(model)
    turn = np.where(chain.prismatic, np.inf, np.pi)
    low, high = np.maximum(chain.lower, -turn), np.minimum(chain.upper, turn)
    margin = 0.05 * (high - low)
    return rng.uniform(low + margin, high - margin, (count, chain.n_joints))


def compiled_microseconds(model: RobotModel, targets: Array, near: Array) -> tuple[float, float, float]:
    """Time a pose of forward model, first-order and exact command in C (gcc -O2), microseconds, best of 20 rounds."""
    code = export_c(model, "robot")
    n, joints = near.shape
    numbers = ",\n".join(repr(float(v)) for v in targets[:, :3].ravel())
    starts = ",\n".join(repr(float(v)) for v in near.ravel())
    main = f"""
#include <stdio.h>
#include <time.h>
#include "robot.h"
static const double target[{12 * n}] = {{{numbers}}};
static const double near_q[{joints * n}] = {{{starts}}};
static double seconds(void) {{ return (double)clock() / CLOCKS_PER_SEC; }}
int main(void) {{
    robot_conditions c = {{robot_payload_load, {{0.0}}}};
    double q[{joints}], T[12], sum = 0.0, start, once, t[3] = {{1e9, 1e9, 1e9}};
    int i, round, kind;
    for (kind = 0; kind < 3; ++kind) {{
        for (round = 0; round < 20; ++round) {{
            start = seconds();
            for (i = 0; i < {n}; ++i) {{
                if (kind == 0) {{ robot_forward(near_q + {joints} * i, &c, T); sum += T[3]; }}
                if (kind == 1) {{ sum += robot_first_order(target + 12 * i, &c, near_q + {joints} * i, q, 0) + q[0]; }}
                if (kind == 2) {{ sum += robot_exact(target + 12 * i, &c, near_q + {joints} * i, q, 0, 0) + q[0]; }}
            }}
            once = (seconds() - start) / {n} * 1e6;
            if (once < t[kind]) {{ t[kind] = once; }}
        }}
    }}
    printf("%g %g %g %g\\n", t[0], t[1], t[2], sum);
    return 0;
}}
"""
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        (here / code.header_name).write_text(code.header)
        (here / code.source_name).write_text(code.source)
        (here / "main.c").write_text(main)
        flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror"]
        subprocess.run(["gcc", *flags, "-o", "run", "main.c", code.source_name, "-lm"], cwd=here, check=True)
        answer = subprocess.run([str(here / "run")], check=True, capture_output=True, text=True).stdout.split()
    return float(answer[0]), float(answer[1]), float(answer[2])


def _row(errors: Array) -> str:
    if not len(errors):
        return f"{'-':>10} {'-':>10} {'-':>10}"
    mm = 1e3 * np.linalg.norm(errors[:, :3], axis=1)
    return f"{np.mean(mm):10.2e} {np.quantile(mm, 0.95):10.2e} {np.max(mm):10.2e}"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    timings = []
    print(f"remaining tool error in mm, {options.poses} poses over the workspace")
    head = f"{'robot':22} {'command':12} {'poses':>6} {'mean':>10} {'95 %':>10} {'max':>10}"
    print(f"{head}   near a limit of the inverse: max (poses)")
    for name, payload in ROBOTS.items():
        model = real_robot(read_robot(ROOT / "configs" / "robots" / f"{name}.yaml"), payload, rng)
        kernel = Kernel(model)
        q = workspace(model, options.poses, rng)
        world_T_base, flange_T_tool = cell_frames(kernel)
        # wanted frames are nominally reachable ones; a SCARA cannot follow the real robot's tilt
        wanted = world_T_base @ forward(chain_of(model), q) @ flange_T_tool
        weak = conditioning(model, q) < 0.02
        for method in ("none", "first_order", "exact"):
            answer = compensate(kernel, wanted, payload="load", near=q, settings=CompensationSettings(method=method))
            regular = answer.reachable & ~weak
            hard = answer.reachable & weak
            worst = f"{1e3 * np.max(np.linalg.norm(answer.remaining[hard, :3], axis=1)):10.2e}" if hard.any() else "-"
            label = {"none": "nominal", "first_order": "one step", "exact": "iterated"}[method]
            row = _row(answer.remaining[regular])
            print(f"{name:22} {label:12} {regular.sum():6d} {row}   {worst:>10} ({hard.sum()})")
        if shutil.which("gcc"):
            timings.append((name, *compiled_microseconds(model, wanted[:500], q[:500])))
    print("\ncompiled C (gcc -O2, one core), microseconds a pose, best of 20 rounds")
    print(f"{'robot':22} {'forward':>10} {'one step':>10} {'iterated':>10}")
    for name, forward_us, first_us, exact_us in timings:
        print(f"{name:22} {forward_us:10.2f} {first_us:10.2f} {exact_us:10.2f}")


if __name__ == "__main__":
    main()

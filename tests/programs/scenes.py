"""A robot with deviations, postures that it reaches, and programs written for it.

In the programs `@F3:a:b@` is posture 3 as a Cartesian target with tool a in base b, `@J3@` its joint values, `@S3@` its
status and turn in KRL, `@T:a@` and `@B:b@` the numbers of a tool and a base, in the dialect's own form.
"""

import re
from pathlib import Path

import numpy as np
import yaml

from fixtures.rigid import Array, frame_from_six, roll_pitch_yaw, vector_from_rotation
from fixtures.true_robot import Circumstances, TrueRobot

DESCRIPTION = yaml.safe_load(Path("configs/robots/kr150_class.yaml").read_text(encoding="utf-8"))
DEVIATIONS = {
    "axis1.z": 8e-4, "axis2.x": -6e-4, "axis2.pitch": 9e-4, "axis3.pitch": -7e-4, "axis3.roll": 3e-4,
    "axis4.roll": 6e-4, "axis5.pitch": -8e-4, "axis6.roll": 1e-3, "axis4.z": 4e-4,
    "axis2.elastic_pitch": 4e-7, "axis3.elastic_pitch": 6e-7,
}  # fmt: skip
FRAMES = {
    "n": np.eye(4),
    "a": frame_from_six([0.1, -0.02, 0.3, 0.2, -0.1, 0.4]),
    "b": frame_from_six([-0.05, 0.08, 0.22, -0.3, 0.2, -1.1]),
    "c": frame_from_six([1.2, 0.3, 0.4, 0.02, -0.01, 0.5]),
    "d": frame_from_six([1.0, -0.5, 0.6, -0.03, 0.02, -0.9]),
}
Q = np.radians([
    [20, -50, 95, 35, 40, -60], [-5, -40, 80, 25, 55, -40], [5, -65, 100, 15, 45, -30], [30, -45, 70, 40, 60, -70],
    [-10, -60, 110, 20, 50, -75], [33, -42, 75, 55, 35, -15], [12, -70, 105, 12, 30, -25], [8, -48, 88, 44, 64, -45],
])  # fmt: skip
"""Neighbours of one configuration, so that the nearest solution is the one that was meant."""


_TRUE = TrueRobot(DESCRIPTION, DEVIATIONS)
_NOMINAL = TrueRobot({**DESCRIPTION, "parameters": {}, "gravity_m_s2": [0.0, 0.0, 0.0]})


def true(q: Array) -> Array:
    """base_T_flange (n, 4, 4) of the real robot."""
    return _TRUE.world_T_tool(np.atleast_2d(q), Circumstances.plain(len(np.atleast_2d(q)), 6))


def nominal(q: Array) -> Array:
    """base_T_flange (n, 4, 4) that the controller believes."""
    return _NOMINAL.world_T_tool(np.atleast_2d(q), Circumstances.plain(len(np.atleast_2d(q)), 6))


def _quaternion(R: Array) -> Array:
    w = vector_from_rotation(R)
    angle = float(np.linalg.norm(w))
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * w / angle if angle else w)])


def written(T: Array, dialect: str) -> str:
    """A frame in a dialect's own numbers."""
    x, y, z = T[:3, 3] * 1e3
    roll, pitch, yaw = np.degrees(roll_pitch_yaw(T[:3, :3]))
    if dialect == "krl":
        pairs = zip("XYZABC", (x, y, z, yaw, pitch, roll), strict=True)
        return ", ".join(f"{n} {v:.5f}" for n, v in pairs)
    if dialect == "rapid":
        q = ",".join(f"{v:.9f}" for v in _quaternion(T[:3, :3]))
        return f"[{x:.4f},{y:.4f},{z:.4f}],[{q}]"
    if dialect == "urscript":
        return ", ".join(f"{v:.8f}" for v in [*T[:3, 3], *vector_from_rotation(T[:3, :3])])
    return (
        f"\tX =  {x:8.3f}  mm,\tY =  {y:8.3f}  mm,\tZ =  {z:8.3f}  mm,\n"
        f"\tW =  {roll:8.3f} deg,\tP =  {pitch:8.3f} deg,\tR =  {yaw:8.3f} deg"
    )


def joints(q: Array, dialect: str) -> str:
    """Joint values in a dialect's own numbers."""
    if dialect == "urscript":
        return ", ".join(f"{v:.6f}" for v in q)
    d = np.degrees(q)
    if dialect == "krl":
        return ", ".join(f"A{k + 1} {v:.4f}" for k, v in enumerate(d))
    if dialect == "rapid":
        return "[" + ",".join(f"{v:.4f}" for v in d) + "]"
    cells = [f"J{k + 1}=  {v:8.3f} deg" for k, v in enumerate(d)]
    return "\t" + ",\t".join(cells[:3]) + ",\n\t" + ",\t".join(cells[3:])


def turn(q: Array) -> int:
    """KRL's T."""
    return sum(1 << k for k, v in enumerate(q) if v < 0)


def filled(template: str, dialect: str) -> str:
    """A program with its numbers."""

    def number(match: re.Match[str]) -> str:
        kind, index, tool, base = match[1], match[2], match[3] or "n", match[4] or "n"
        if kind in "TB":
            return written(FRAMES[tool], dialect)
        q = Q[int(index)]
        if kind == "J":
            return joints(q, dialect)
        if kind == "S":
            return f"S 2, T {turn(q)}"
        T = np.linalg.inv(FRAMES[base]) @ nominal(q)[0] @ FRAMES[tool]
        return written(T, dialect)

    text = re.sub(r"@([FJTBS])(\d*):?(\w?):?(\w?)@", number, template)
    return re.sub(r"\r?\n", "\r\n", text) if "\r\n" in text else text

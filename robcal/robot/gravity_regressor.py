"""The moment of unknown weights about a line of a chain, as linear functions of unknown first moments.

With `g` the gravity, the moment about a line `l` through a frame's origin of all bodies behind it is
``l . sum_j (m_j (o_j - o) + R_j s_j) x g``: linear in the masses `m_j` and first moments `s_j` (Gautier and Khalil,
1990: base inertial parameters). Written in the frame in which the line is fixed, every joint angle occurs once, on the
near side (gravity) or on the far side (bodies), so each function is a sum of products of sines and cosines.
"""

import math
from collections.abc import Iterable, Mapping
from functools import lru_cache

import numpy as np

from robcal.robot.model import Frame, RobotModel, Triple

Polynomial = Mapping[tuple[str, ...], float]
"""Products of factors (`cos(q2)`, `sin(q3)`, `q4` ..., sorted) to their coefficients."""
Matrix = list[list[Polynomial]]

NEGLIGIBLE = 1e-9
DEPENDENT = 1e-6
SAMPLES = 400
LONGEST = 900
"""Characters of one expression."""


def direction_of_gravity(model: RobotModel) -> Triple:
    """Unit vector of gravity in base coordinates, by the reference of the base."""
    gravity = np.array(model.gravity, dtype=float)
    if model.gravity_frame == "world" and model.world_T_base is not None:
        gravity = model.world_T_base[:3, :3].T @ gravity
    x, y, z = np.round(gravity / max(float(np.linalg.norm(gravity)), 1e-12), 6).tolist()
    return (x, y, z)


@lru_cache(maxsize=1024)
def regressor(frames: tuple[Frame, ...], gravity: Triple, frame: str, angle: str, links: int) -> tuple[Polynomial, ...]:
    """Independent functions of the joint angles that make up the moment about the line of an angle of a frame.

    Parameters
    ----------
    gravity : its direction in base coordinates. angle : roll, pitch or yaw of the frame.
    links : number of bodies behind the line that count, the frame's own first.

    The functions are those of unit first moments under unit gravity, nominal geometry. Dependent ones, and what is
    constant, are left out.
    """
    at = next(i for i, f in enumerate(frames) if f.name == frame)
    numbers = _numbers(frames)
    near, far = _identity(), _identity()
    for f in frames[:at]:
        near = _product(near, _rotation(f, numbers[f.name], "yaw", "pitch", "roll"))
    order = ("yaw", "pitch", "roll")
    split = order.index(angle)
    near = _product(near, _rotation(frames[at], numbers[frame], *order[:split]))
    far = _rotation(frames[at], numbers[frame], *order[split:])
    g = [_sum(_scaled(near[i][k], gravity[i]) for i in range(3)) for k in range(3)]
    line = 2 - split
    p, q = (line + 1) % 3, (line + 2) % 3

    def moment(v: list[Polynomial]) -> Polynomial:
        return _sum((_times(v[p], g[q]), _scaled(_times(v[q], g[p]), -1.0)))

    found = [moment([far[i][k] for i in range(3)]) for k in range(3)]
    arm: list[Polynomial] = [{}, {}, {}]
    for f in frames[at + 1 :][: links - 1]:
        offset = _offset(f, numbers[f.name])
        arm = [_sum((arm[i], *(_times(far[i][k], offset[k]) for k in range(3)))) for i in range(3)]
        far = _product(far, _rotation(f, numbers[f.name], *order))
        found += [moment(arm), *(moment([far[i][k] for i in range(3)]) for k in range(3))]
    return _independent(found, max(numbers.values()))


def expressions(function: Polynomial) -> tuple[str, ...]:
    """A function in the language of terms, as parts to be added, none too long for one expression."""
    parts: list[str] = []
    for factors, value in function.items():
        text = "*".join([repr(round(value, 12)), *factors])
        if parts and len(parts[-1]) + len(text) < LONGEST:
            parts[-1] += f" + {text}"
        else:
            parts.append(text)
    return tuple(parts)


def _numbers(frames: tuple[Frame, ...]) -> dict[str, int]:
    """Number (from 1) of the joint in each frame, zero for fixed frames."""
    joints = [f.name for f in frames if f.axis is not None]
    return {f.name: joints.index(f.name) + 1 if f.name in joints else 0 for f in frames}


def _rotation(f: Frame, number: int, *angles: str) -> Matrix:
    """Product of the frame's elementary rotations about the named angles, in that order."""
    out = _identity()
    for angle in angles:
        k = ("roll", "pitch", "yaw").index(angle)
        c, s = math.cos(f.rpy[k]), math.sin(f.rpy[k])
        cosine: Polynomial = {(): c}
        sine: Polynomial = {(): s}
        if angle == f.joint_kind:
            cos, sin = (f"cos(q{number})",), (f"sin(q{number})",)
            cosine, sine = {cos: c, sin: -f.sign * s}, {cos: s, sin: f.sign * c}
        i, j = (k + 1) % 3, (k + 2) % 3
        turn = _identity()
        turn[i][i] = turn[j][j] = _clean(cosine)
        turn[i][j], turn[j][i] = _clean(_scaled(sine, -1.0)), _clean(sine)
        out = _product(out, turn)
    return out


def _offset(f: Frame, number: int) -> list[Polynomial]:
    """Translation of a frame in its parent; a sliding joint's own way is a factor."""
    out: list[Polynomial] = [_clean({(): v}) for v in f.xyz]
    if f.prismatic and f.axis is not None:
        k = "xyz".index(f.axis)
        out[k] = _sum((out[k], {(f"q{number}",): float(f.sign)}))
    return out


def _independent(found: list[Polynomial], joints: int) -> tuple[Polynomial, ...]:
    """Those of the functions that are no combination of earlier ones and of a constant."""
    rng = np.random.default_rng(0)
    q = rng.uniform(-math.pi, math.pi, (SAMPLES, joints))
    factors = {f"{name}(q{k + 1})": getattr(np, name)(q[:, k]) for k in range(joints) for name in ("cos", "sin")}
    factors |= {f"q{k + 1}": q[:, k] for k in range(joints)}
    basis = np.full((SAMPLES, 1), SAMPLES**-0.5)
    kept: list[Polynomial] = []
    for function in found:
        value = np.zeros(SAMPLES)
        for names, coefficient in function.items():
            value += coefficient * np.prod([factors[n] for n in names], axis=0)
        rest = value - basis @ (basis.T @ value)
        if np.linalg.norm(rest) > DEPENDENT * SAMPLES**0.5:
            basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
            kept.append(function)
    return tuple(kept)


def _identity() -> Matrix:
    return [[{(): 1.0} if i == k else {} for k in range(3)] for i in range(3)]


def _product(a: Matrix, b: Matrix) -> Matrix:
    return [[_sum(_times(a[i][j], b[j][k]) for j in range(3)) for k in range(3)] for i in range(3)]


def _times(a: Polynomial, b: Polynomial) -> Polynomial:
    return _sum({tuple(sorted(m + n)): x * y} for m, x in a.items() for n, y in b.items())


def _scaled(a: Polynomial, factor: float) -> Polynomial:
    return {m: factor * x for m, x in a.items()}


def _sum(parts: Iterable[Polynomial]) -> Polynomial:
    out: dict[tuple[str, ...], float] = {}
    for part in parts:
        for m, x in part.items():
            out[m] = out.get(m, 0.0) + x
    return _clean(out)


def _clean(a: Polynomial) -> Polynomial:
    return {m: x for m, x in a.items() if abs(x) > NEGLIGIBLE}

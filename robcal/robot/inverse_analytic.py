"""Closed-form inverse kinematics of six-axis arms: all branches from the joint lines, for many poses at once.

Both structures are solved with the subproblems of :mod:`robcal.robot.inverse_analytic` on
``D = base_T_flange home^-1 = E_1 ... E_6``; fixed frames of any kind are absorbed in the lines and in ``home``.
Branches stand in the second axis, eight of them; NaN where one does not exist.

Subproblems of Paden and Kahan: joint angles from one geometric condition each, vectorised.

Sources: Murray, Li, Sastry, *A Mathematical Introduction to Robotic Manipulation* (1994), section 3.3;
Elias and Wen, *IK-Geo* (2022), for the fourth (moving a point onto a plane).

Directions are unit vectors. Arguments broadcast over leading axes; two solutions come in a new last axis. Where the
condition cannot be met the angles are NaN; a condition missed by rounding alone (``_EDGE`` of the cosine) is met at the
boundary, so an arm stretched out to its full reach still has its solution.
"""

import numpy as np

from robcal.robot.chain import Chain
from robcal.robot.structure import ParallelArm, SphericalWrist
from robcal.transforms import Array, invert

_EDGE = 1e-9


def _dot(a: Array, b: Array) -> Array:
    return np.sum(a * b, axis=-1)


def _across(w: Array, u: Array) -> Array:
    """Component of u perpendicular to w."""
    return u - _dot(w, u)[..., None] * w


def _arccos(cosine: Array) -> Array:
    inside = np.abs(cosine) <= 1.0 + _EDGE
    return np.where(inside, np.arccos(np.clip(np.where(inside, cosine, 0.0), -1.0, 1.0)), np.nan)


def rotate(w: Array, angle: Array, u: Array) -> Array:
    """Vectors u turned about direction w by angle (Rodrigues)."""
    along = _dot(w, u)[..., None] * w
    across = u - along
    c, s = np.cos(angle)[..., None], np.sin(angle)[..., None]
    return along + c * across + s * np.cross(w, across)


def angle_between(w: Array, u: Array, v: Array) -> Array:
    """Angle about w that turns u towards v (subproblem 1; only the components across w count)."""
    a, b = _across(w, u), _across(w, v)
    return np.arctan2(_dot(w, np.cross(a, b)), _dot(a, b))


def two_turns(w1: Array, w2: Array, u: Array, v: Array) -> tuple[Array, Array]:
    """Angles (t1, t2), shape (..., 2), with ``rot(w1, t1) rot(w2, t2) u = v`` for crossing axes (subproblem 2)."""
    c = _dot(w1, w2)
    a, b = _dot(w1, v), _dot(w2, u)
    s2 = 1.0 - c * c
    alpha, beta = (a - c * b) / s2, (b - c * a) / s2
    gamma2 = (_dot(u, u) - alpha**2 - beta**2 - 2.0 * alpha * beta * c) / s2
    scale = _dot(u, u) / s2
    possible = gamma2 >= -_EDGE * scale
    gamma = np.sqrt(np.where(possible, np.maximum(gamma2, 0.0), np.nan))
    plane = alpha[..., None] * w1 + beta[..., None] * w2
    z = plane[..., None, :] + np.stack([gamma, -gamma], axis=-1)[..., None] * np.cross(w1, w2)[..., None, :]
    t2 = angle_between(w2[..., None, :], u[..., None, :], z)
    t1 = angle_between(w1[..., None, :], z, v[..., None, :])
    return t1, t2


def to_distance(w: Array, u: Array, v: Array, distance2: Array) -> Array:
    """Angles (..., 2) with ``|v - rot(w, t) u|^2 = distance2`` (subproblem 3)."""
    a, b = _across(w, u), _across(w, v)
    rest = distance2 - _dot(w, u - v) ** 2
    product = np.sqrt(_dot(a, a) * _dot(b, b))
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (_dot(a, a) + _dot(b, b) - rest) / (2.0 * product)
    middle, half = angle_between(w, a, b), _arccos(cosine)
    return np.stack([middle + half, middle - half], axis=-1)


def to_plane(w: Array, u: Array, normal: Array, height: Array) -> Array:
    """Angles (..., 2) with ``normal . rot(w, t) u = height`` (subproblem 4)."""
    across = _across(w, u)
    a, b = _dot(normal, across), _dot(normal, np.cross(w, across))
    rest = height - _dot(w, u) * _dot(normal, w)
    with np.errstate(divide="ignore", invalid="ignore"):
        half = _arccos(rest / np.hypot(a, b))
    middle = np.arctan2(b, a)
    return np.stack([middle + half, middle - half], axis=-1)


_SINGULAR = 1e-9


def solve_spherical_wrist(chain: Chain, structure: SphericalWrist, base_T_flange: Array, near: Array) -> Array:
    """Joint angles (n, 8, 6) of an arm whose last three axes meet.

    The wrist centre is not moved by axes 4 to 6, so axes 1 to 3 must carry it to ``D centre``; what is left of the
    rotation is the wrist's. Where axes 4 and 6 are aligned, axis 4 keeps its value of ``near`` (n, 6).
    """
    D = base_T_flange @ invert(chain.home)
    goal = np.einsum("nij,j->ni", D[:, :3, :3], structure.centre) + D[:, :3, 3]
    arm = _arm_angles(chain, structure, goal)
    n = len(D)
    q = np.repeat(arm, 2, axis=1)
    w = chain.axes
    # rotation left for the wrist: (E1 E2 E3)^-1 D
    undone = np.broadcast_to(D[:, None, :3, :3], (n, arm.shape[1], 3, 3)).swapaxes(-1, -2)
    columns = [np.swapaxes(undone, -1, -2)[..., k] for k in range(3)]
    for i in range(3):
        columns = [rotate(w[i], -arm[..., i], column) for column in columns]
    wrist = np.stack(columns, axis=-1)
    pointing = np.einsum("nbij,j->nbi", wrist, w[5])
    t4, t5 = two_turns(
        np.broadcast_to(w[3], pointing.shape),
        np.broadcast_to(w[4], pointing.shape),
        np.broadcast_to(w[5], pointing.shape),
        pointing,
    )
    aligned = np.linalg.norm(np.cross(w[3], pointing), axis=-1) < _SINGULAR
    t4 = np.where(aligned[..., None], near[:, None, None, 3], t4)
    kept = rotate(w[3], -t4, np.broadcast_to(pointing[..., None, :], (*t4.shape, 3)))
    t5 = np.where(aligned[..., None], angle_between(w[4], np.broadcast_to(w[5], kept.shape), kept), t5)
    probe = perpendicular(w[5])
    turned = np.einsum("nbij,j->nbi", wrist, probe)
    turned = np.broadcast_to(turned[..., None, :], (*t4.shape, 3))
    turned = rotate(w[4], -t5, rotate(w[3], -t4, turned))
    t6 = angle_between(w[5], np.broadcast_to(probe, turned.shape), turned)
    full = np.concatenate([q, np.stack([t.reshape(n, -1) for t in (t4, t5, t6)], axis=-1)], axis=-1)
    # axis 4 free: the two wrist branches are one
    twin = np.repeat(aligned, 2, axis=1)
    twin[:, ::2] = False
    full[twin] = np.nan
    full[np.any(np.isnan(full), axis=-1)] = np.nan
    return full


def _arm_angles(chain: Chain, structure: SphericalWrist, goal: Array) -> Array:
    """Angles (n, 4, 3) of axes 1 to 3 with ``E1 E2 E3 centre = goal``."""
    w, p, c = chain.axes, chain.points, structure.centre
    if structure.arm == "parallel_23":
        # heights along the common direction of axes 2 and 3 do not change by them
        height = np.broadcast_to(w[1] @ (c - p[0]), goal.shape[:1])
        t1 = -to_plane(w[0], goal - p[0], w[1], height)  # (n, 2): goal seen before axis 1 turned
        seen = p[0] + rotate(w[0], -t1, (goal - p[0])[:, None])
        reach2 = np.sum((seen - p[1]) ** 2, axis=-1)
        t3 = to_distance(w[2], c - p[2], p[1] - p[2], reach2)  # (n, 2, 2)
        placed = p[2] + rotate(w[2], t3, c - p[2])
        t2 = angle_between(w[1], placed - p[1], (seen - p[1])[..., None, :])
        return _combine(t1[..., None], t2, t3)
    if structure.arm == "meeting_12":
        s = structure.shoulder if structure.shoulder is not None else p[0]
        reach2 = np.sum((goal - s) ** 2, axis=-1)
        t3 = to_distance(w[2], c - p[2], s - p[2], reach2)  # (n, 2)
        placed = p[2] + rotate(w[2], t3, c - p[2]) - s
        wanted = np.broadcast_to((goal - s)[:, None], placed.shape)
        t1, t2 = two_turns(np.broadcast_to(w[0], placed.shape), np.broadcast_to(w[1], placed.shape), placed, wanted)
        return _combine(t1, t2, t3[..., None])
    # parallel_12: heights along axes 1 and 2 are axis 3's alone
    t3 = to_plane(w[2], c - p[2], w[0], (goal - p[2]) @ w[0])  # (n, 2)
    placed = p[2] + rotate(w[2], t3, c - p[2])
    reach = goal - p[0]
    t2 = to_distance(w[1], placed - p[1], p[0] - p[1], np.sum(reach**2, axis=-1)[:, None])
    elbow = p[1] + rotate(w[1], t2, (placed - p[1])[..., None, :])
    t1 = angle_between(w[0], elbow - p[0], reach[:, None, None])
    return _combine(t1, t2, t3[..., None])


def solve_parallel_arm(chain: Chain, structure: ParallelArm, base_T_flange: Array, near: Array) -> Array:
    """Joint angles (n, 8, 6) of an arm whose axes 2, 3, 4 are parallel and whose axes 5, 6 meet.

    Axes 2 to 4 leave heights along their common direction alone: that gives axis 1, then 5, then 6; what remains is a
    plane problem. Where axis 6 is parallel to axes 2 to 4, axis 6 keeps its value of ``near`` (n, 6).
    """
    w, p, c = chain.axes, chain.points, structure.centre
    n_ = w[1]
    D = base_T_flange @ invert(chain.home)
    n = len(D)
    goal = np.einsum("nij,j->ni", D[:, :3, :3], c) + D[:, :3, 3]
    t1 = -to_plane(w[0], goal - p[0], n_, np.broadcast_to(n_ @ (c - p[0]), (n,)))  # (n, 2)
    # E1^-1 D
    pointing = rotate(w[0], -t1, (D[:, :3, :3] @ w[5])[:, None])
    t5 = to_plane(w[4], np.broadcast_to(w[5], pointing.shape), n_, pointing @ n_)  # (n, 2, 2)
    q1 = np.repeat(t1, 2, axis=1)  # (n, 4)
    q5 = t5.reshape(n, 4)
    # direction n_ seen from behind axis 6: E6 (E1^-1 D)^-1 n = E5^-1 n
    behind = np.einsum("nji,nbj->nbi", D[:, :3, :3], rotate(w[0], q1, np.broadcast_to(n_, (n, 4, 3))))
    before = rotate(w[4], -q5, np.broadcast_to(n_, (n, 4, 3)))
    q6 = angle_between(w[5], behind, before)
    aligned = np.linalg.norm(np.cross(w[5], before), axis=-1) < _SINGULAR
    q6 = np.where(aligned, near[:, None, 5], q6)
    # G = E1^-1 D E6^-1 E5^-1 = E2 E3 E4 acts in planes across n_; follow a point of axis 4 and a direction
    q1, q5, q6 = (np.repeat(t, 2, axis=1) for t in (q1, q5, q6))
    carried = _point_through(chain, D, q1, q5, q6, p[3])
    reach2 = np.sum((carried[:, ::2] - p[1]) ** 2, axis=-1)
    q3 = to_distance(w[2], p[3] - p[2], p[1] - p[2], reach2).reshape(n, 8)
    placed = p[2] + rotate(w[2], q3, p[3] - p[2])
    q2 = angle_between(w[1], placed - p[1], carried - p[1])
    probe = perpendicular(n_)
    ahead = _point_through(chain, D, q1, q5, q6, p[3] + probe) - carried
    ahead = rotate(w[2], -q3, rotate(w[1], -q2, ahead))
    q4 = angle_between(w[3], np.broadcast_to(probe, ahead.shape), ahead)
    full = np.stack([q1, q2, q3, q4, q5, q6], axis=-1)
    full[np.any(np.isnan(full), axis=-1)] = np.nan
    return full


def _point_through(chain: Chain, D: Array, q1: Array, q5: Array, q6: Array, x: Array) -> Array:
    """``E1^-1 D E6^-1 E5^-1 x`` for angles (n, b)."""
    w, p = chain.axes, chain.points
    y = p[4] + rotate(w[4], -q5, np.broadcast_to(x - p[4], (*q5.shape, 3)))
    y = p[5] + rotate(w[5], -q6, y - p[5])
    y = np.einsum("nij,nbj->nbi", D[:, :3, :3], y) + D[:, None, :3, 3]
    return p[0] + rotate(w[0], -q1, y - p[0])


def _combine(*angles: Array) -> Array:
    """Angles that broadcast over (n, 2, 2) to (n, 4, 3)."""
    stacked = np.stack(np.broadcast_arrays(*angles), axis=-1)
    return stacked.reshape(len(stacked), -1, len(angles))


def perpendicular(direction: Array) -> Array:
    """A unit vector across a direction."""
    other = np.eye(3)[np.argmin(np.abs(direction))]
    v = np.cross(direction, other)
    return v / np.linalg.norm(v)

"""Do the motions of the flange carry a hand-eye calibration? What is missing, in words.

The camera's place in its carrier is unique if the carrier turns about two directions that are not parallel (Tsai and
Lenz 1989); turns about one direction leave a shift along it open, poses that only shift leave the whole place open.
"""

import numpy as np

from robcal.errors import NotIdentifiable
from robcal.handeye.data import Mounted
from robcal.robot.model import RobotModel
from robcal.transforms import Array, log_so3

LEAST_TURN = np.radians(1.5)
"""Turns smaller than this about a second direction are none."""
WEAK_TURN = np.radians(15.0)
"""Below this the place of the camera hangs on few degrees."""


def turns(base_T_flange: Array) -> tuple[Array, Array]:
    """How far (3,) rad the flange turns about three directions (columns of (3, 3), in flange coordinates), most first.

    Root mean square over all pairs of poses of the part of the relative turn about each direction.
    """
    R = base_T_flange[:, :3, :3]
    i, j = np.triu_indices(len(R), 1)
    if len(i) > 4000:
        keep = np.random.default_rng(1).choice(len(i), 4000, replace=False)
        i, j = i[keep], j[keep]
    w = log_so3(np.swapaxes(R[i], 1, 2) @ R[j])
    # of turns by half a circle and more only the direction counts
    values, axes = np.linalg.eigh(w.T @ w / max(len(w), 1))
    return np.sqrt(np.maximum(values[::-1], 0.0)), axes[:, ::-1]


def distinct(base_T_flange: Array) -> int:
    """Number of poses that differ by more than 0.1 mm or 0.01 degrees from all before."""
    kept: list[Array] = []
    for T in base_T_flange:
        near = [
            np.linalg.norm(T[:3, 3] - K[:3, 3]) < 1e-4 and np.linalg.norm(T[:3, :3] - K[:3, :3]) < 2.5e-4 for K in kept
        ]
        if not any(near):
            kept.append(T)
    return len(kept)


def check_motion(
    base_T_flange: Array, mounted: Mounted, model: RobotModel | None = None, q: Array | None = None
) -> None:
    """Refuse poses that cannot tell where the camera is, and name the motion that is missing.

    Parameters
    ----------
    model, q : the robot and the joint angles (n, N) of the poses, to say which joints stood still.

    Raises
    ------
    NotIdentifiable : fewer than three poses, no turns, or turns about one direction only.
    """
    n = distinct(base_T_flange)
    sees = "camera" if mounted == "hand" else "board"
    if n < 3:
        raise NotIdentifiable(
            f"{n} different pose{'s' if n != 1 else ''} with the board in view: a hand-eye calibration needs three or "
            "more, better fifteen to thirty, that turn the flange by 30 degrees or more about different directions: "
            "add poses"
        )
    size, axes = turns(base_T_flange)
    if size[0] < LEAST_TURN:
        raise NotIdentifiable(
            f"the flange never turns (by {np.degrees(size[0]):.1f} degrees at most), it only shifts: the place of the "
            f"{sees} at the flange cannot be told: add poses that turn the flange by 30 degrees or more about two "
            f"directions{_perhaps_radians(q)}"
        )
    if size[1] < LEAST_TURN:
        a = _direction(axes)
        raise NotIdentifiable(
            f"all poses turn the flange about one direction only ({a[0]:.2f}, {a[1]:.2f}, {a[2]:.2f} in flange "
            f"coordinates{_still(model, q)}): a shift of the {sees} along it cannot be told: add poses that turn the "
            f"flange by 30 degrees or more {_across(a)}{_perhaps_radians(q)}"
        )


def weak_motion(base_T_flange: Array) -> str:
    """A sentence where the second turn is small; empty if all is well."""
    size, axes = turns(base_T_flange)
    if size[1] >= WEAK_TURN:
        return ""
    a = _direction(axes)
    return (
        f"the flange turns by {np.degrees(size[0]):.0f} degrees about ({a[0]:.2f}, {a[1]:.2f}, {a[2]:.2f}) in its own "
        f"coordinates, but by {np.degrees(size[1]):.1f} degrees only across that: poses that turn it by 30 degrees or "
        f"more {_across(a)} would make the result sharper"
    )


def _direction(axes: Array) -> Array:
    """(3,) the first direction, its largest component positive, without minus zeros."""
    a = axes[:, 0] * np.sign(axes[np.argmax(np.abs(axes[:, 0])), 0])
    return np.round(a, 2) + 0.0


def _across(a: Array) -> str:
    """Coordinate axes of the flange that lie most across a direction, in words."""
    order = np.argsort(np.abs(a))
    return f"about its {'xyz'[order[0]]} or {'xyz'[order[1]]} axis as well"


def _still(model: RobotModel | None, q: Array | None) -> str:
    if model is None or q is None:
        return ""
    moving = [f.name for f, spread in zip(model.joints, np.ptp(q, axis=0), strict=True) if spread > 1e-3]
    return f"; joints that move: {', '.join(moving)}" if moving else ""


def _perhaps_radians(q: Array | None) -> str:
    """A doubt where several joints move, but none is ever further from zero than half a turn in radians would be."""
    if q is None or not q.size or np.degrees(np.abs(q).max()) > np.pi or np.sum(np.ptp(q, axis=0) > 1e-3) < 3:
        return ""
    return f" (no joint angle is beyond {np.degrees(np.abs(q).max()):.2f} degrees: are they in radians?)"

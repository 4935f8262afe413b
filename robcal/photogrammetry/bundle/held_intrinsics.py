"""Interior orientation that a network does not determine: held at its start values, or an error with the reason."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NoReturn

import numpy as np

from robcal.errors import NotIdentifiable
from robcal.photogrammetry.bundle.covariance import factorise
from robcal.photogrammetry.bundle.determinacy import singular_unknowns, undetermined
from robcal.photogrammetry.bundle.normals import State
from robcal.photogrammetry.bundle.solver import Problem
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera
from robcal.photogrammetry.core.network import IntArray
from robcal.transforms import Array

_REMEDY = (
    "take images tilted by 30 to 45 degrees in different directions and rolled by 90 degrees, "
    "or give a camera calibration"
)
_PAIRS: dict[str, tuple[str, ...]] = {name: pair for pair in (("p1", "p2"), ("cx", "cy")) for name in pair}
"""Numbers that are held together."""


@dataclass(frozen=True)
class FreeIntrinsics:
    """Names of the estimated numbers (``f``: fx and fy changed alike), and (name, reason) of those given up."""

    names: tuple[str, ...]
    left_out: tuple[tuple[str, str], ...] = ()


def undetermined_intrinsics(problem: Problem, state: State, free: Sequence[str], Q: Array) -> tuple[str, ...]:
    """Free intrinsics that the marks do not determine, worst first; ``Q`` are the cofactors of all unknowns."""
    if not free:
        return ()
    sigma = np.sqrt(np.maximum(np.diag(Q)[: len(free)], 0.0))
    marks, c = problem.order.marks, state.camera
    ideal = (marks.xy - [c.cx, c.cy]) / [c.fx, c.fy]
    return undetermined(free, sigma, c, float(np.max(np.linalg.norm(ideal, axis=1))))


def raise_singular(problem: Problem, state: State, free: Sequence[str], ids: IntArray) -> NoReturn:
    """Raise the error that names the unknowns which singular normal equations do not determine.

    Raises
    ------
    NotIdentifiable : always.
    """
    _, damped = factorise(problem, state, 1e-9)
    S = damped.equilibrated + damped.constraints @ damped.constraints.T
    names = singular_unknowns(S, free, ids.tolist())
    raise NotIdentifiable(
        f"the images do not determine {', '.join(names)}: take images from more directions, tilted up to 45 degrees "
        "and rolled by 90 degrees, or give a camera calibration",
        names,
    )


def hold_undetermined(
    bad: Sequence[str],
    free: FreeIntrinsics,
    camera: Camera,
    start: Camera,
    *,
    undetermined: Literal["leave_out", "raise"],
    hold_focal: bool,
) -> tuple[FreeIntrinsics, Camera]:
    """Hold the first of the undetermined numbers (with its pair) at its value in ``start``.

    Raises
    ------
    NotIdentifiable : nothing may be held (``undetermined`` 'raise'), or it is the focal length and that may not.
    """
    if undetermined == "raise":
        raise NotIdentifiable(f"the images do not determine {', '.join(bad)}: {_REMEDY}", tuple(bad))
    first = bad[0]
    group = _PAIRS.get(first, (first,))
    names, values = free.names, camera.vector
    if {"fx", "fy"} <= set(names) and first in ("fx", "fy"):
        # perhaps only their ratio is open (a plane seen without roll): then one number for both
        values[1] = values[0] * start.fy / start.fx
        reason = "its ratio to fx is not determined by these images, held at its start value"
        one = FreeIntrinsics(("f", *(n for n in names if n not in ("fx", "fy"))), (*free.left_out, ("fy", reason)))
        return one, camera.with_vector(values)
    if first in ("fx", "fy", "f"):
        if not hold_focal:
            raise NotIdentifiable(
                f"the images do not determine the focal length ({', '.join(bad)}) against the distance: {_REMEDY}",
                tuple(bad),
            )
        group = ("fx", "fy", "f")
    held = tuple((name, "not determined by these images, held at its start value") for name in group if name in names)
    rows = [INTRINSIC_NAMES.index(name) for name in group if name in INTRINSIC_NAMES]
    values[rows] = start.vector[rows]
    remaining = FreeIntrinsics(tuple(n for n in names if n not in group), (*free.left_out, *held))
    return remaining, camera.with_vector(values)

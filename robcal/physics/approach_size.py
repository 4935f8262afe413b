"""A joint that stops short or overshoots in proportion to its last move: controllers, soft belts, creeping grease."""

from collections.abc import Iterator

import numpy as np

from robcal.cause import Kind
from robcal.physics.cause import Basis, Entry, RobotCause
from robcal.physics.site import Joint, RobotSite, each_joint

APPROACH_SIZE = Kind(
    "approach_size",
    "robot",
    "error that grows with the size of a joint's last move",
    "{where} misses its angle by {deg_per_deg:.2e} of the move that brought it there",
)
TYPICAL = 2e-4
"""Error (rad or m) after a move of the usual size."""
WEIGHT = 0.3
"""Prior weight: most joints lag behind by the direction of their last move, not by its size."""


def _approach_size(site: RobotSite, joint: Joint) -> Iterator[RobotCause]:
    name = f"move{joint.number}"
    if not site.varies(name, 1e-6):
        return
    typical = float(np.sqrt(np.mean(site.variables[name] ** 2)))
    yield RobotCause(
        APPROACH_SIZE,
        *joint.place,
        ("share",),
        (TYPICAL / typical,),
        lambda v, c: {"deg_per_deg": float(v[0])},
        bases=lambda c: (Basis(joint.frame, "q", name, "share"),),
        covariates=(name,),
        weight=WEIGHT,
    )


ENTRIES = (Entry(on_robot=each_joint(_approach_size)),)

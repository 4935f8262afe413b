"""Sets of poses that cannot tell base and tool apart: what is missing, in words, with the remedy.

Base and tool are the two unknowns of the robot-world and hand-eye problem ``M_i = W T_i F``; they are unique if the
flange turns about two directions that are not parallel (Zhuang, Roth, Sudhakar 1994; Tsai and Lenz 1989 for the
hand-eye part). With fewer, a part of the tool stays where it was constructed, and the base with it.
"""

from collections.abc import Collection, Mapping

import numpy as np

from robcal import transforms as tf
from robcal.robot.model import RobotModel
from robcal.transforms import Array

SAME_ANGLE = 1e-3
"""rad; joints that move less stand still."""
LEAST_TURN = np.radians(5.0)
"""Turns of the flange below this separate base and tool by the noise of the measurement at best."""
WEAK = 5e-3
"""Standard deviation (m) of the tool's place above which base and tool count as not separated."""
REMEDY = (
    "give poses that turn the tool by 30 deg or more about two directions, or hold the tool (flange_T_tool in the "
    "robot file)"
)


def describe_deficiency(
    model: RobotModel, q: Array, base_T_flange: Array, held: Collection[str], sigma: Mapping[str, float]
) -> str:
    """A sentence on what base and tool lack; empty if the poses separate them.

    Parameters
    ----------
    q : (n, N) joint values; base_T_flange : (n, 4, 4) flange at these poses.
    held : names of the parameters that the data left open (``tool.x``, ...); sigma : of the others, by name.
    """
    places = [f"{end}.{k}" for end in ("base", "tool") for k in "xyz"]
    open_names = [n for n in places if n in held]
    uncertain = max((sigma.get(n, 0.0) for n in places), default=0.0)
    if not open_names and uncertain < WEAK:
        return ""
    turns = tf.log_so3(np.swapaxes(base_T_flange[:1, :3, :3], 1, 2) @ base_T_flange[:, :3, :3])
    size = np.linalg.norm(turns, axis=1).max(initial=0.0)
    across = np.linalg.svd(turns, compute_uv=False)[1] / np.sqrt(len(turns)) if len(turns) > 1 else 0.0
    moving = [f.name for f, spread in zip(model.joints, np.ptp(q, axis=0), strict=True) if spread > SAME_ANGLE]
    if len(moving) == 1:
        why = f"only joint {moving[0]} moves"
    elif size < LEAST_TURN:
        why = f"orientation is constant (within {np.degrees(size):.1f} deg)"
    elif across < 0.5 * LEAST_TURN:
        why = "all poses turn the tool about one direction only"
    else:
        why = "the poses turn the tool too little for what the model leaves unexplained"
    bound = f"their places are uncertain by {1e3 * uncertain:.0f} mm (1 sigma)"
    if open_names:
        bound = (
            f"{', '.join(open_names)} stays as stated in the robot file, or at the flange: predictions hold at such "
            "poses only, and the base is off by as much as the tool is"
        )
    return f"base and tool cannot be separated: {why}; {bound}. To determine both, {REMEDY}"

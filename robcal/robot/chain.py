"""The nominal chain as joint lines at zero position: fast forward kinematics, link frames and Jacobian in numpy.

Every joint of a :class:`~robcal.robot.model.RobotModel` (rotary about x, y or z, or sliding, with any fixed angles
before and after it) is a screw about a line that stands still while the joints before it are at zero. With those lines
``base_T_flange = E_1(q_1) ... E_N(q_N) M`` (product of exponentials; Murray, Li, Sastry 1994, section 3.2), the form in
which inverse kinematics sees the structure of a robot whatever parametrisation its file uses.

Frames that turn by the angles of several joints or by a four-bar (:mod:`robcal.robot.loops`) are lines as well; their
angles ``u`` follow from q by the chain's coupling, and the Jacobian is that of the lines times ``du/dq``.

Only nominal geometry lives here. Deviations, elasticities and terms are the kernel's business.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.errors import InvalidInput
from robcal.robot.loops import Coupling, FourBar
from robcal.robot.model import Frame, RobotModel
from robcal.transforms import Array, frame_from_xyzrpy, rotation_from_rpy, skew


@dataclass(frozen=True)
class Chain:
    """Joint lines at zero position in base coordinates, and what is fixed to them.

    Attributes
    ----------
    names : names of the joint frames.
    prismatic : (N,) sliding joints.
    axes : (L, 3) unit directions of positive q (``sign`` included); L = N lines unless the chain has loops.
    points : (L, 3) a point on each line, m (the origin of the line's frame at zero).
    home : (4, 4) base_T_flange with all lines at zero.
    frames_home : (F, 4, 4) base_T_frame of every frame of the model with all lines at zero.
    moved_by : (F,) index of the last line that moves each frame, -1 for those that stand still.
    lower, upper : (N,) limits in rad or m, -inf and inf where unknown.
    coupling : of chains with loops, how the lines turn with the joints; None where each line is a joint.
    sliding : (L,) lines that slide; given with a coupling.
    own_line : (N,) index of each joint's own line; given with a coupling.
    """

    names: tuple[str, ...]
    prismatic: NDArray[np.bool_]
    axes: Array
    points: Array
    home: Array
    frames_home: Array
    moved_by: NDArray[np.int_]
    lower: Array
    upper: Array
    coupling: Coupling | None = None
    sliding: NDArray[np.bool_] | None = None
    own_line: NDArray[np.int_] | None = None

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return len(self.names)

    @property
    def line_slides(self) -> NDArray[np.bool_]:
        """(L,) lines that slide."""
        return self.prismatic if self.sliding is None else self.sliding

    @property
    def line_of_joint(self) -> NDArray[np.int_]:
        """(N,) index of each joint's own line."""
        return np.arange(self.n_joints) if self.own_line is None else self.own_line

    def line_angles(self, q: Array) -> Array:
        """Angles (or ways) of all lines (n, L) at joint values (n, N)."""
        return q if self.coupling is None else self.coupling.angles(q)

    def closes(self, q: Array) -> NDArray[np.bool_]:
        """(n,) whether the chain's loops close at joint values (n, N)."""
        return np.ones(len(q), dtype=bool) if self.coupling is None else self.coupling.closes(q)


def chain_of(model: RobotModel) -> Chain:
    """Joint lines of the nominal geometry of a model (its parameters and terms are ignored).

    Raises
    ------
    InvalidInput : the robot is a Stewart platform.
    """
    if model.is_hexapod:
        raise InvalidInput(f"robot '{model.name}' is a Stewart platform: this works for chains of joints only")
    T = np.eye(4)
    axes, points, frames, moved_by, lines = [], [], [], [], []
    for f in model.frames:
        parent = T
        T = parent @ frame_from_xyzrpy([*f.xyz, *f.rpy])
        if f.axis is not None:
            # The line about which that very angle turns: yaw about the parent's z, pitch about y turned by yaw, roll
            # about the frame's own x; a sliding joint moves along the parent's axes.
            local = np.eye(3)["xyz".index(f.axis)]
            if not f.prismatic:
                roll, pitch, yaw = f.rpy
                turned = {"z": (0.0, 0.0, 0.0), "y": (0.0, 0.0, yaw), "x": (roll, pitch, yaw)}[f.axis]
                local = rotation_from_rpy(turned) @ local
            axes.append(f.sign * (parent[:3, :3] @ local))
            points.append(T[:3, 3])
            lines.append(f)
        frames.append(T)
        moved_by.append(len(lines) - 1)
    joints = model.joints
    limits = np.array([f.limits if f.limits is not None else (-np.inf, np.inf) for f in joints], dtype=float)
    return Chain(
        tuple(f.name for f in joints),
        np.array([f.prismatic for f in joints], bool),
        np.array(axes),
        np.array(points),
        T,
        np.array(frames),
        np.array(moved_by),
        limits[:, 0],
        limits[:, 1],
        *((None, None, None) if not model.has_loops else _couplings(lines)),
    )


def _couplings(lines: Sequence[Frame]) -> tuple[Coupling, NDArray[np.bool_], NDArray[np.int_]]:
    """Coupling of moving frames, which of them slide, and the line of each joint."""
    own = np.array([i for i, f in enumerate(lines) if f.is_joint])
    matrix = np.zeros((len(lines), len(own)))
    matrix[own, np.arange(len(own))] = 1.0
    bars: list[tuple[int, FourBar]] = []
    for i, f in enumerate(lines):
        for k, coefficient in f.follows:
            matrix[i, k] = f.sign * coefficient  # the line has the sign in its direction
        if f.fourbar is not None:
            matrix[i] = 0.0
            bars.append((i, f.fourbar))
    return Coupling(matrix, tuple(bars)), np.array([f.prismatic for f in lines], bool), own


def check_joint_angles(chain: Chain, q: ArrayLike) -> Array:
    """Joint values as (n, N) floats.

    Raises
    ------
    InvalidInput : wrong number of joints or values that are not finite; the message names the row.
    """
    values = np.atleast_2d(np.asarray(q, dtype=float))
    if values.ndim != 2 or values.shape[1] != chain.n_joints:
        raise InvalidInput(f"expected {chain.n_joints} joint values a row, got an array of shape {np.shape(q)}")
    bad = np.flatnonzero(~np.all(np.isfinite(values), axis=1))
    if len(bad):
        raise InvalidInput(f"row {bad[0] + 1}: a joint value is not a finite number; remove or repair the row")
    return values


def line_motions(chain: Chain, q: Array) -> Array:
    """Exponentials ``E_i(u_i)`` of all lines, shape (n, L, 4, 4), of line angles (n, L) (without loops: q)."""
    n, count = q.shape
    out = np.zeros((n, count, 4, 4))
    out[..., 3, 3] = 1.0
    W = skew(chain.axes)
    c, s = np.cos(q)[..., None, None], np.sin(q)[..., None, None]
    turn = np.eye(3) + s * W + (1.0 - c) * (W @ W)
    slide = chain.line_slides[:, None]
    out[..., :3, :3] = np.where(slide[..., None], np.eye(3), turn)
    about = chain.points - np.einsum("nkij,kj->nki", turn, chain.points)
    out[..., :3, 3] = np.where(slide, q[..., None] * chain.axes, about)
    return out


def cumulative_motions(chain: Chain, q: Array) -> Array:
    """``E_1 ... E_i`` for i = 0 (identity) to L, shape (n, L + 1, 4, 4), for joint values (n, N)."""
    E = line_motions(chain, chain.line_angles(q))
    out = np.empty((len(q), len(chain.axes) + 1, 4, 4))
    out[:, 0] = np.eye(4)
    for i in range(len(chain.axes)):
        out[:, i + 1] = out[:, i] @ E[:, i]
    return out


def forward(chain: Chain, q: ArrayLike) -> Array:
    """Nominal base_T_flange (n, 4, 4) of joint values (n, N) or (N,)."""
    return cumulative_motions(chain, check_joint_angles(chain, q))[:, -1] @ chain.home


def frame_positions(chain: Chain, q: ArrayLike) -> Array:
    """base_T_frame of every frame of the model, shape (n, F, 4, 4)."""
    motions = cumulative_motions(chain, check_joint_angles(chain, q))
    return motions[:, chain.moved_by + 1] @ chain.frames_home


def forward_and_jacobian(chain: Chain, q: ArrayLike) -> tuple[Array, Array]:
    """base_T_flange (n, 4, 4) and its right twist (rho, omega) in flange coordinates per joint, (n, 6, N)."""
    values = check_joint_angles(chain, q)
    motions = cumulative_motions(chain, values)
    T = motions[:, -1] @ chain.home
    before = motions[:, :-1]
    axes = np.einsum("nkij,kj->nki", before[..., :3, :3], chain.axes)
    points = np.einsum("nkij,kj->nki", before[..., :3, :3], chain.points) + before[..., :3, 3]
    turning = np.cross(axes, T[:, None, :3, 3] - points)
    slide = chain.line_slides[:, None]
    linear = np.where(slide, axes, turning)
    angular = np.where(slide, 0.0, axes)
    twist = np.concatenate([linear @ T[:, :3, :3], angular @ T[:, :3, :3]], axis=-1)
    lines = np.swapaxes(twist, 1, 2)
    return T, lines if chain.coupling is None else lines @ chain.coupling.slopes(values)


def limit_excess(chain: Chain, q: Array) -> Array:
    """How far each joint value lies beyond its limits, (..., N), negative below, positive above, zero within."""
    return np.minimum(q - chain.lower, 0.0) + np.maximum(q - chain.upper, 0.0)

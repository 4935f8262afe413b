"""A world or a tool of an instrument: what is known of its six coordinates, and how it moves.

Coordinates are x, y, z along the axes of the outer frame and roll, pitch, yaw, as in files, wherever some of them are
known; an end of which nothing is known is perturbed on the right, which has no singular orientation.
"""

from dataclasses import dataclass, replace

import numpy as np

from robcal import transforms as tf
from robcal.errors import InvalidInput
from robcal.robot.model import GEOMETRIC_KINDS
from robcal.transforms import Array

FREE, FIXED = np.inf, 0.0
LOCKED = 0.02
"""Cosine of pitch below which roll and yaw cannot be told apart."""


@dataclass(frozen=True)
class CellFrame:
    """``world_T_base`` ('base') or ``flange_T_tool`` ('tool') of one instrument or of several that share it.

    Attributes
    ----------
    name : of the instrument that it belongs to; its parameters are ``<name>.<end>.<x..yaw>``.
    given : (6,) x, y, z (m), roll, pitch, yaw (rad), NaN where nothing is stated.
    sigma : (6,) standard deviation of what is given: 0 is known, infinite is free.
    certified : whether the angles are held only as long as the measurements do not tell them better.

    Raises
    ------
    InvalidInput : a coordinate is said to be known and not given, or angles at a pitch of 90 degrees are known in part.
    """

    name: str
    end: str
    given: tuple[float, ...] = (np.nan,) * 6
    sigma: tuple[float, ...] = (FREE,) * 6
    certified: bool = False

    def __post_init__(self) -> None:
        for kind, value, sigma in zip(GEOMETRIC_KINDS, self.given, self.sigma, strict=True):
            if np.isfinite(sigma) and not np.isfinite(value):
                raise InvalidInput(f"{self.title}: {kind} is not free but has no value: state it, or leave it free")
        if self._by_angles and abs(np.cos(self.given[4])) < LOCKED:
            raise InvalidInput(
                f"{self.title}: at a pitch of 90 degrees roll and yaw turn about one line and cannot be held one by "
                "one: hold all three angles, or leave them free"
            )

    @property
    def title(self) -> str:
        """Name for messages."""
        return f"{'world_T_base' if self.end == 'base' else 'flange_T_tool'} of instrument '{self.name}'"

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of all six coordinates."""
        return tuple(f"{self.name}.{self.end}.{kind}" for kind in GEOMETRIC_KINDS)

    @property
    def unknown(self) -> tuple[str, ...]:
        """Names of the coordinates that are not fixed."""
        return tuple(n for n, sigma in zip(self.parameter_names, self.sigma, strict=True) if sigma > FIXED)

    @property
    def priors(self) -> dict[str, float]:
        """Standard deviations of the coordinates that are known with an uncertainty."""
        pairs = zip(self.parameter_names, self.sigma, strict=True)
        return {name: sigma for name, sigma in pairs if FIXED < sigma < FREE}

    @property
    def _along_outer_axes(self) -> bool:
        return not all(np.isinf(self.sigma[:3]))

    @property
    def _by_angles(self) -> bool:
        """Whether single angles matter; alike in all three, a turn may be taken in the frame's own coordinates."""
        return len(set(self.sigma[3:])) > 1

    def twist(self, T: Array) -> Array:
        """Right twist (6, 6) of a frame (4, 4) per unit of its coordinates."""
        out = np.eye(6)
        if self._along_outer_axes:
            out[:3, :3] = T[:3, :3].T
        if self._by_angles:
            out[3:, 3:] = tf.twist_from_six(tf.xyzrpy_from_frame(T)[None])[0, 3:, 3:]
        return out

    def moved(self, T: Array, step: Array) -> Array:
        """The frame (4, 4) with its coordinates moved by a step (6,)."""
        if not np.any(step):
            return T
        place = T[:3, 3] + (step[:3] if self._along_outer_axes else T[:3, :3] @ step[:3])
        if self._by_angles:
            turn = tf.rotation_from_rpy(tf.rpy_from_rotation(T[:3, :3]) + step[3:])
        else:
            turn = T[:3, :3] @ tf.rotation_from_rpy(step[3:])
        return tf.frame(turn, place)

    def deviation(self, T: Array) -> Array:
        """How far the coordinates (6,) of a frame are from what is given; zero where nothing is."""
        given = np.array(self.given)
        out = tf.xyzrpy_from_frame(T) - given
        out[3:] = (out[3:] + np.pi) % (2.0 * np.pi) - np.pi
        if not self._by_angles and np.all(np.isfinite(given[3:])):
            out[3:] = tf.log_so3(tf.rotation_from_rpy(given[3:]).T @ T[:3, :3])
        return np.where(np.isfinite(self.sigma), out, 0.0)

    def with_free_angles(self) -> "CellFrame":
        """The same with angles of which the given ones are start values."""
        return replace(self, sigma=(*self.sigma[:3], FREE, FREE, FREE), certified=False)

    def start(self, T: Array, *, stated: bool = False) -> Array:
        """A frame (4, 4) with the coordinates that are known put in; ``stated`` : also those given as start values."""
        given = np.array(self.given)
        put = np.isfinite(given) & (stated | np.isfinite(self.sigma))
        six = tf.xyzrpy_from_frame(T)
        if not put[3:].any():
            return tf.frame(T[:3, :3], np.where(put[:3], given[:3], T[:3, 3]))
        return tf.frame_from_xyzrpy(np.where(put, given, six))

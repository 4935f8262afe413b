"""Closed loops in a chain: frames that turn by the angles of joints instead of, or besides, a joint of their own.

A planar loop is made serial by the angle that it drives: ``T(phi) = S(G(phi))`` with the joint angles ``phi``, the
serial chain ``S`` and the coupling ``G`` (Schroeer 1993, *Identifikation von Kalibrationsparametern kinematischer
Ketten*). ``G`` is linear for parallelograms and gear trains. For a four-bar it is the rocker's angle: with crank
``a``, coupler ``b``, rocker ``c``, ground ``g``, and both angles counted from the ground line (crank pivot to rocker
pivot) in the same sense, ``d = (g - a cos phi, -a sin phi)`` leads from the crank's pin to the rocker's pivot and

    ``psi = pi + atan2(d_y, d_x) -+ acos((c^2 + |d|^2 - b^2) / (2 c |d|))``

(Freudenstein 1955 in the form of the two triangles that the diagonal makes), minus for the open assembly, plus for the
crossed one.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.errors import InvalidInput

Array = NDArray[np.float64]

FOUR_BAR_LENGTHS = ("crank", "coupler", "rocker", "ground")
FOUR_BAR_KINDS = (*FOUR_BAR_LENGTHS, "crank_angle", "elastic_crank")
"""Parameters of a four-bar: deviations of its lengths (m) and of the crank's angle (rad), and the elasticity of what
turns the crank (rad/(N m), by the moment that the weights exert on the crank)."""


@dataclass(frozen=True)
class FourBar:
    """A crank turned by a joint that turns a frame by way of a coupler.

    Attributes
    ----------
    driver : index (from 0) of the joint that turns the crank.
    lengths : crank, coupler, rocker, ground, m.
    crank_zero : rad, crank angle at zero of the driver.
    assembly : 'open' or 'crossed': on which side of the diagonal the coupler lies.

    Raises
    ------
    InvalidInput : lengths that close in no position.
    """

    driver: int
    lengths: tuple[float, float, float, float]
    crank_zero: float = 0.0
    assembly: Literal["open", "crossed"] = "open"

    def __post_init__(self) -> None:
        if fault := impossible_lengths(self.lengths):
            raise InvalidInput(f"four-bar: {fault}")

    @property
    def side(self) -> float:
        """+1 for the open assembly, -1 for the crossed one."""
        return 1.0 if self.assembly == "open" else -1.0


def impossible_lengths(lengths: tuple[float, ...]) -> str:
    """Why four lengths (m) make no loop, in words; empty if they do."""
    if len(lengths) != 4 or not all(math.isfinite(v) and v > 0 for v in lengths):
        return "its four lengths must be positive"
    longest, rest = max(lengths), sum(lengths) - max(lengths)
    if longest >= rest:
        name = FOUR_BAR_LENGTHS[lengths.index(longest)]
        return (
            f"the {name} of {1e3 * longest:g} mm is as long as the three others together ({1e3 * rest:g} mm), so the "
            "loop closes in no position"
        )
    return ""


def closing(lengths: Any, phi: Any) -> Any:
    """Cosine of the angle between rocker and diagonal, by lengths (4,) and crank angle; beyond 1 nothing closes."""
    a, b, c, g = (lengths[k] for k in range(4))
    cos = ca.cos if isinstance(phi, ca.SX) else np.cos
    root = ca.sqrt if isinstance(phi, ca.SX) else np.sqrt
    square = a * a + g * g - 2.0 * a * g * cos(phi)
    return (c * c + square - b * b) / (2.0 * c * root(square))


def rocker_angle(bar: FourBar, phi: Any, lengths: Any = None) -> Any:
    """Rocker angle psi of crank angles phi, numbers or a graph; where nothing closes, that of the dead position."""
    lengths = bar.lengths if lengths is None else lengths
    graph = isinstance(phi, ca.SX)
    a, g = lengths[0], lengths[3]
    cosine = closing(lengths, phi)
    if graph:
        apex = ca.acos(ca.fmin(ca.fmax(cosine, -1.0), 1.0))
        return math.pi + ca.atan2(-a * ca.sin(phi), g - a * ca.cos(phi)) - bar.side * apex
    apex = np.arccos(np.clip(cosine, -1.0, 1.0))
    return math.pi + np.arctan2(-a * np.sin(phi), g - a * np.cos(phi)) - bar.side * apex


def rocker_slope(bar: FourBar, phi: ArrayLike) -> Array:
    """``d psi / d phi``, from the loop's two equations: ``a sin(phi - theta) / (c sin(psi - theta))``, theta the
    coupler's angle; zero where nothing closes."""
    a, _, c, g = bar.lengths
    crank = np.asarray(phi, dtype=float)
    psi = rocker_angle(bar, crank)
    coupler = np.arctan2(c * np.sin(psi) - a * np.sin(crank), g + c * np.cos(psi) - a * np.cos(crank))
    below = c * np.sin(psi - coupler)
    closes = np.abs(closing(bar.lengths, crank)) < 1.0
    return np.where(closes, a * np.sin(crank - coupler) / np.where(closes, below, 1.0), 0.0)


@dataclass(frozen=True)
class Coupling:
    """How the lines of a nominal chain turn with its joints: ``u = C q``, four-bars by their rocker angle.

    Attributes
    ----------
    matrix : (L, N) linear part; a row of a four-bar is zero.
    bars : four-bars by the index of their line.
    """

    matrix: Array
    bars: tuple[tuple[int, FourBar], ...] = ()

    def angles(self, q: Array) -> Array:
        """Line angles (n, L) of joint values (n, N)."""
        u = q @ self.matrix.T
        for line, bar in self.bars:
            u[:, line] += rocker_angle(bar, q[:, bar.driver] + bar.crank_zero)
        return u

    def slopes(self, q: Array) -> Array:
        """``du/dq`` (n, L, N)."""
        out = np.broadcast_to(self.matrix, (len(q), *self.matrix.shape)).copy()
        for line, bar in self.bars:
            out[:, line, bar.driver] += rocker_slope(bar, q[:, bar.driver] + bar.crank_zero)
        return out

    def closes(self, q: Array) -> NDArray[np.bool_]:
        """(n,) whether every four-bar closes at joint values (n, N)."""
        out = np.ones(len(q), dtype=bool)
        for _, bar in self.bars:
            out &= np.abs(closing(bar.lengths, q[:, bar.driver] + bar.crank_zero)) <= 1.0
        return out

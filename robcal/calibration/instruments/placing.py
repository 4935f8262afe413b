"""World and tool of one instrument on a robot that is known: start values, and instruments that only verify."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from robcal import transforms as tf
from robcal.calibration.instruments.cell_frame import CellFrame
from robcal.calibration.instruments.evaluator import Part
from robcal.calibration.observations import Stack
from robcal.calibration.start_values import candidates
from robcal.errors import InvalidInput, NotIdentifiable
from robcal.estimation.covariance import cofactor
from robcal.estimation.dependence import split_dependent
from robcal.estimation.gauss_newton import gauss_newton
from robcal.estimation.summary import TerminationSettings
from robcal.transforms import Array

Pair = tuple[Array, Array]
PLAUSIBLE = 0.1
"""What the measurements leave open by more than this (m, rad) stays as it was constructed."""
START = TerminationSettings(25, 6, 1e-3)


@dataclass(frozen=True)
class Placement:
    """World and tool of an instrument.

    Attributes
    ----------
    world_T_base, flange_T_tool : (4, 4).
    covariance : (12, 12) of right perturbations of both, m and rad; zero where held.
    held : coordinates that the measurements do not tell, ``world_T_base.roll`` and the like.
    cost : half the whitened sum of squares, priors included.
    """

    world_T_base: Array
    flange_T_tool: Array
    covariance: Array = field(repr=False)
    held: tuple[str, ...]
    cost: float


class _CellProblem:
    """Residuals of one instrument by the coordinates of its world and tool alone; a state is the pair of frames."""

    def __init__(self, part: Part, base_T_flange: Array, located: Mapping[str, Array], scatter: Array | None) -> None:
        self.part, self.chain = part, base_T_flange
        self.stack = Stack(part.observations, len(part.poses))
        self.ends = (part.world, part.tool)
        unknown = [n for end in self.ends for n in end.unknown if end.parameter_names[0] not in located]
        self.names = [n for end in self.ends for n in end.parameter_names]
        self.columns = [k for k, n in enumerate(self.names) if n in unknown]
        self.scatter = scatter
        self.whitener = np.zeros(0)
        self.held: tuple[str, ...] = ()

    def frames(self, pair: Pair) -> Array:
        return pair[0] @ self.chain @ pair[1]

    def whiten_at(self, pair: Pair) -> None:
        stacked = self.stack.evaluate(self.frames(pair))
        C = self.stack.covariance(self.frames(pair))
        if self.scatter is not None:
            C = C + tf.transport_covariance(stacked.B, self.scatter)
        self.whitener = np.linalg.inv(np.linalg.cholesky(C))

    def hold_open_coordinates(self, pair: Pair) -> None:
        """Leave alone what the measurements do not tell."""
        names = [self.names[k] for k in self.columns]
        J = self.linearise(pair)[1]
        kept, gone = split_dependent(J.T @ J, names, np.full(len(names), PLAUSIBLE), ties=False)
        self.columns = [self.columns[k] for k in kept]
        self.held = tuple(coordinate_title(e.name) for e in gone)

    def residuals(self, pair: Pair) -> Array:
        r = np.einsum("nij,nj->ni", self.whitener, self.stack.evaluate(self.frames(pair)).r)[self.stack.used]
        return np.concatenate([r, *(self._prior(end, T)[0] for end, T in zip(self.ends, pair, strict=True))])

    def linearise(self, pair: Pair) -> tuple[Array, Array]:
        W, F = pair
        by_base = tf.adjoint(tf.invert(self.chain @ F)) @ self.part.world.twist(W)
        by_tool = np.broadcast_to(self.part.tool.twist(F), by_base.shape)
        B = self.stack.evaluate(self.frames(pair)).B
        J = (self.whitener @ (B @ np.concatenate([by_base, by_tool], axis=2)))[self.stack.used]
        (_, world), (_, tool) = (self._prior(end, T) for end, T in zip(self.ends, pair, strict=True))
        rows = np.zeros((len(world) + len(tool), 12))
        rows[: len(world), :6], rows[len(world) :, 6:] = world, tool
        return self.residuals(pair), np.concatenate([J, rows])[:, self.columns]

    def retract(self, pair: Pair, step: Array) -> Pair:
        full = np.zeros(12)
        full[self.columns] = step
        return self.part.world.moved(pair[0], full[:6]), self.part.tool.moved(pair[1], full[6:])

    @staticmethod
    def _prior(end: CellFrame, T: Array) -> tuple[Array, Array]:
        sigma = np.array(end.sigma)
        known = np.isfinite(sigma) & (sigma > 0)
        return -end.deviation(T)[known] / sigma[known], np.diag(1.0 / np.where(known, sigma, 1.0))[known]


def place(
    part: Part,
    base_T_flange: Array,
    located: Mapping[str, Array] | None = None,
    *,
    near: Pair | None = None,
    scatter: Array | None = None,
) -> Placement:
    """World and tool of an instrument by least squares, on a robot whose flange frames are known.

    Parameters
    ----------
    base_T_flange : (n, 4, 4) at the poses of the part.
    located : frames by the first parameter name of worlds and tools that are known already (shared with others).
    near : values to start from instead of constructing some.
    scatter : (n, 6, 6) covariance of the tool's twist beside that of the measurements.

    Raises
    ------
    NotIdentifiable : nothing can be constructed and nothing is given.
    """
    located = located or {}
    best: tuple[float, Pair, _CellProblem] | None = None
    for pair in [near] if near is not None else _starts(part, base_T_flange, located):
        problem = _CellProblem(part, base_T_flange, located, scatter)
        problem.whiten_at(pair)
        problem.hold_open_coordinates(pair)
        try:
            found, summary = gauss_newton(problem.linearise, problem.residuals, problem.retract, pair, START)
        except (InvalidInput, np.linalg.LinAlgError):
            continue
        if best is None or summary.cost < best[0]:
            best = (summary.cost, found, problem)
    if best is None:
        raise NotIdentifiable(
            f"no start values for world and tool of instrument '{part.name}' can be constructed from its "
            f"{len(part.poses)} poses: measure more of them, or give world_T_base and flange_T_tool",
            (part.name,),
        )
    return _placement(best[2], best[1], best[0])


def _placement(problem: _CellProblem, pair: Pair, cost: float) -> Placement:
    problem.whiten_at(pair)
    covariance = np.zeros((12, 12))
    if problem.columns:
        covariance[np.ix_(problem.columns, problem.columns)] = cofactor(problem.linearise(pair)[1])
    turn = np.zeros((12, 12))
    turn[:6, :6], turn[6:, 6:] = problem.part.world.twist(pair[0]), problem.part.tool.twist(pair[1])
    return Placement(*pair, tf.transport_covariance(turn, covariance), problem.held, cost)


def coordinate_title(name: str) -> str:
    """``world_T_base.roll`` of a parameter ``<instrument>.base.roll``."""
    _, end, kind = name.rsplit(".", 2)
    return f"{'world_T_base' if end == 'base' else 'flange_T_tool'}.{kind}"


def _starts(part: Part, base_T_flange: Array, located: Mapping[str, Array]) -> list[Pair]:
    """Pairs of frames worth trying: constructed from the measurements, and as stated."""
    stated = part.tool.start(np.eye(4), stated=True)
    turn = stated[:3, :3] if np.isfinite(part.tool.given[3:]).all() else None
    made = candidates(base_T_flange, part.observations, stated, turn)
    pairs = [(part.world.start(W), part.tool.start(F)) for W, F in made]
    world, tool = part.world.parameter_names[0], part.tool.parameter_names[0]
    if world in located or np.isfinite(part.world.given).any():
        pairs += [(part.world.start(np.eye(4), stated=True), F) for _, F in pairs or [(stated, stated)]]
    return [(located.get(world, W), located.get(tool, F)) for W, F in pairs]

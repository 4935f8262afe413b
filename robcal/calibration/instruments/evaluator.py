"""The robot's chain once for each instrument, its columns mapped into one list of parameters.

Parameters are those of the kernel (base and tool of the kernel itself stay at zero), then the six coordinates of every
world, then of every tool. Rows are poses of instruments: a pose that two instruments saw is two rows, so all that the
estimation knows of poses holds for several instruments as it does for one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.calibration.instruments.cell_frame import CellFrame
from robcal.calibration.measurements import RobotObservations
from robcal.calibration.observations import DistanceObservations, Stack, Stacked
from robcal.calibration.problem import Evaluation, Evaluator, State, joint_scatter
from robcal.calibration.wire import Wire
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import GEOMETRIC_KINDS
from robcal.transforms import Array

Rows = NDArray[np.intp]


@dataclass(frozen=True)
class Part:
    """One instrument's share: poses (n), observations by their row, world and tool, free parameters of a wire."""

    name: str
    poses: PoseInputs = field(repr=False)
    observations: tuple[RobotObservations, ...] = field(repr=False)
    world: CellFrame
    tool: CellFrame
    wire: tuple[str, ...] = ()

    @property
    def wire_names(self) -> tuple[str, ...]:
        """Names of the wire's free parameters."""
        return tuple(f"{self.name}.wire.{kind}" for kind in self.wire)

    def with_wire(self, values: Array) -> tuple[RobotObservations, ...]:
        """The observations at values (k,) of the wire's free parameters."""
        if not self.wire:
            return self.observations
        given: dict[str, Any] = dict(zip(self.wire, map(float, values), strict=True))
        return tuple(
            replace(o, wire=replace(o.wire or Wire(), **given)) if isinstance(o, DistanceObservations) else o
            for o in self.observations
        )


class JointEvaluator(Evaluator):
    """Residuals and derivatives of several instruments.

    In its states ``world_T_base`` is (worlds, 4, 4) and ``flange_T_tool`` (tools, 4, 4), in the order of :attr:`worlds`
    and :attr:`tools`.

    Weakness: where two instruments saw the same stop of the robot, its scatter of the joints counts as two.
    """

    def __init__(self, kernel: Kernel, parts: Sequence[Part]) -> None:
        self.parts = tuple(parts)
        self.worlds = tuple({p.world.name: p.world for p in parts}.values())
        self.tools = tuple({p.tool.name: p.tool for p in parts}.values())
        self._world_of = [[w.name for w in self.worlds].index(p.world.name) for p in parts]
        self._tool_of = [[t.name for t in self.tools].index(p.tool.name) for p in parts]
        ends = np.cumsum([len(p.poses) for p in parts])
        self.rows: tuple[Rows, ...] = tuple(np.split(np.arange(ends[-1], dtype=np.intp), ends[:-1]))
        observations = [
            replace(o, pose=o.pose + rows[0])
            for p, rows in zip(self.parts, self.rows, strict=True)
            for o in p.observations
            if len(rows)
        ]
        q = np.concatenate([p.poses.q for p in self.parts])
        load = np.concatenate([p.poses.load for p in self.parts])
        super().__init__(kernel, PoseInputs(q, load), Stack(observations, len(q)))
        self.cell = (*self.worlds, *self.tools)
        names = (*kernel.names, *(n for end in self.cell for n in end.parameter_names))
        self._wires = slice(len(names), len(names) + sum(len(p.wire) for p in parts))
        names = (*names, *(n for p in parts for n in p.wire_names))
        self.index = {name: k for k, name in enumerate(names)}
        wires = [start_of_wire(p) for p in parts]
        self.theta0 = np.concatenate([kernel.theta0, np.zeros(6 * len(self.cell)), *wires])
        self.theta0[[*self._base, *self._tool]] = 0.0

    def columns_of(self, end: CellFrame) -> slice:
        """Where the six coordinates of a world or tool stand."""
        first = self.index[end.parameter_names[0]]
        return slice(first, first + 6)

    def placed(self, state: State, part: int) -> tuple[Array, Array]:
        """``world_T_base`` and ``flange_T_tool`` (4, 4) of an instrument."""
        return state.world_T_base[self._world_of[part]], state.flange_T_tool[self._tool_of[part]]

    def observations_at(self, state: State, part: int) -> tuple[RobotObservations, ...]:
        """Observations of an instrument, by row of its own poses, with the wire's parameters of a state."""
        own = self.parts[part]
        return own.with_wire(state.theta[[self.index[n] for n in own.wire_names]])

    def __call__(self, state: State) -> Evaluation:
        """The evaluation at a state: all instruments, one after the other."""
        for known, evaluation in self._memory:
            if known is state:
                return evaluation
        theta = state.theta[: len(self.kernel.names)]
        T, moments = [], []
        by_parameter = np.zeros((len(self.poses), len(self.index), 6))
        for k, (part, rows) in enumerate(zip(self.parts, self.rows, strict=True)):
            W, F = self.placed(state, k)
            T_k, J, moments_k = self.kernel.with_references(W, F).evaluate(theta, part.poses)
            T.append(T_k)
            moments.append(moments_k)
            J = np.swapaxes(J, 1, 2)
            by_parameter[rows, : J.shape[1]] = J
            for end, columns, frame in ((part.world, self._base, W), (part.tool, self._tool, F)):
                by_parameter[rows, self.columns_of(end)] = end.twist(frame).T @ J[:, columns]
        frames = np.concatenate(T)
        stacked = self._stacked(state, frames, by_parameter)
        evaluation = Evaluation(frames, np.swapaxes(by_parameter, 1, 2), np.concatenate(moments), stacked.r, stacked.B)
        self._memory = [(state, evaluation), *self._memory[:2]]
        return evaluation

    def _stacked(self, state: State, frames: Array, by_parameter: Array) -> Stacked:
        """Residuals; columns of the wires' parameters as the twists of the tool that lengthen the wire as much."""
        if self._wires.start == self._wires.stop:
            return self.stack.evaluate(frames)
        observations = []
        for k, (part, rows) in enumerate(zip(self.parts, self.rows, strict=True)):
            for o in self.observations_at(state, k) if len(rows) else ():
                observations.append(replace(o, pose=o.pose + rows[0]))
                if isinstance(o, DistanceObservations) and o.wire is not None and part.wire:
                    at = observations[-1].pose
                    _, B = o.evaluate(frames[rows])
                    along = B[:, 0] / np.sum(B[:, 0] ** 2, axis=1, keepdims=True)
                    slopes = o.wire.by_parameter(frames[at, :3, 3], part.wire)
                    first = self.index[part.wire_names[0]]
                    by_parameter[at, first : first + len(part.wire)] = slopes[:, :, None] * along[:, None]
        return self.stack.evaluate(frames, observations)

    def fold(self, theta: Array, state: State) -> State:
        """A state with moved parameters, those of worlds and tools folded into their frames."""
        moved = []
        for ends, frames in ((self.worlds, state.world_T_base), (self.tools, state.flange_T_tool)):
            moved.append(np.array([e.moved(T, theta[self.columns_of(e)]) for e, T in zip(ends, frames, strict=True)]))
        theta[len(self.kernel.names) : self._wires.start] = 0.0
        return State(theta, *moved)

    def deviations(self, state: State) -> Array:
        """How far each parameter is from where priors expect it: what the files of robot and wires say, and what is
        given of worlds and tools."""
        out = state.theta - self.theta0
        for end, T in zip(self.cell, (*state.world_T_base, *state.flange_T_tool), strict=True):
            out[self.columns_of(end)] = end.deviation(T)
        return out

    def joint_scatter(self, state: State, joint_sigma: ArrayLike) -> Array:
        """Covariance (n, 6, 6) of the tools' twists from joints that stop with standard deviations ``joint_sigma``."""
        theta = state.theta[: len(self.kernel.names)]
        return np.concatenate(
            [
                joint_scatter(self.kernel, State(theta, *self.placed(state, k)), part.poses, joint_sigma)
                for k, part in enumerate(self.parts)
            ]
        )

    def to_right_twists(self, state: State, part: int) -> Array:
        """(12, 12) from the coordinates of an instrument's world and tool to right perturbations of both frames."""
        W, F = self.placed(state, part)
        out = np.zeros((12, 12))
        out[:6, :6] = self.parts[part].world.twist(W)
        out[6:, 6:] = self.parts[part].tool.twist(F)
        return out


def start_of_wire(part: Part) -> Array:
    """Values (k,) of the wire's free parameters as its measurements state them."""
    stated = next((o.wire for o in part.observations if isinstance(o, DistanceObservations) and o.wire), Wire())
    return np.array([getattr(stated, kind) for kind in part.wire])


def kernel_ends() -> tuple[str, ...]:
    """Names of base and tool in the kernel, in the order of coordinates."""
    return tuple(f"{end}.{kind}" for end in ("base", "tool") for kind in GEOMETRIC_KINDS)

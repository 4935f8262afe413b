"""Zero offsets of the joints of a calibrated robot: geometry, base and tool are held with their covariance.

``T(q + dq)`` is fitted to whatever was measured, so one pose in 6D is enough for six offsets. Where poses were driven
to from both directions, half the difference (lost motion) is a further unknown of that joint, so that offsets are those
of the mean of both. What the measurements cannot tell is left out and named with what does the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.cell import with_fitted_cell
from robcal.calibration.joint_log import JointLog
from robcal.calibration.observations import Observations, Stack
from robcal.cell.adjustment import ASSUMED_TOUCH, Adjusted, Equations, adjust, student_factor
from robcal.cell.carried import CarriedFrames
from robcal.errors import InvalidInput, NotIdentifiable
from robcal.estimation.covariance import global_test
from robcal.estimation.dependence import Eliminated, split_dependent
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import GEOMETRIC_KINDS, Frame
from robcal.transforms import Array, frame_from_xyzrpy, retract

WEAKEST = np.radians(1.0)
"""An offset whose standard deviation would be larger (rad; sliding joints: m times LEVER) is not measured."""
LEVER = 1.0
STRONG_TIE = 0.3
"""Share of the strongest tie above which a tie is named."""
CONTRADICTED = 0.01
"""p-value of the residuals below which the stated covariance of the measurements is not believed."""
MOST_ROWS = 6000


@dataclass(frozen=True)
class Mastering:
    """Zero offsets: the true angle is the indicated one plus the offset, on top of the calibrated robot's own zeros.

    Attributes
    ----------
    joints : (j,) names of the joints whose offsets were found; offsets : (j,) rad or m; covariance : (j, j).
    wide : (j,) half widths of the 95 % intervals.
    unobservable : joint -> what does the same as its offset, in words.
    reversal : joint -> half the lost motion and its standard deviation, rad or m.
    sigma0, redundancy, p_value : of the adjustment, with the covariance as stated.
    robot : with the offsets in force and the covariance of all its parameters.
    """

    joints: tuple[str, ...]
    offsets: Array
    covariance: Array = field(repr=False)
    wide: Array
    unobservable: dict[str, list[str]]
    reversal: dict[str, tuple[float, float]]
    sigma0: float
    redundancy: int
    p_value: float
    robot: CalibratedRobot = field(repr=False)

    @property
    def sigma(self) -> Array:
        """Standard deviations (j,)."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class _State:
    """Joint offsets and half lost motions (N,), and the references of base and tool."""

    offset: Array
    reversal: Array
    world_T_base: Array
    flange_T_tool: Array


class _Problem:
    """Measurements against the robot with other zeros; unknowns by name."""

    def __init__(
        self, kernel: Kernel, inputs: PoseInputs, approach: Array, observations: Sequence[Observations]
    ) -> None:
        self.kernel, self.inputs, self.approach = kernel, inputs, approach
        self.stack = Stack(observations, len(inputs))
        if self.stack.rows > MOST_ROWS:
            raise InvalidInput(f"{self.stack.rows} measured numbers: {MOST_ROWS} at most, leave poses out")
        joints = [f.name for f in kernel.model.joints]
        self.names = (
            *(f"{end}.{kind}" for end in ("base", "tool") for kind in GEOMETRIC_KINDS),
            *joints,
            *(f"reversal of {joint}" for joint in joints),
        )

    def at(self, state: _State) -> tuple[Kernel, PoseInputs]:
        moved = self.inputs.with_q(self.inputs.q + state.offset + self.approach * state.reversal)
        return self.kernel.with_references(state.world_T_base, state.flange_T_tool), moved

    def equations(self, state: _State, chosen: NDArray[np.int64]) -> Equations:
        kernel, inputs = self.at(state)
        T, J, _ = kernel.evaluate(kernel.theta0, inputs)
        ends = [kernel.index[name] for name in self.names[:12]]
        Jq = kernel.joint_jacobian(kernel.theta0, inputs)
        every = np.concatenate([J[:, :, ends], Jq, Jq * self.approach[:, None, :]], axis=2)[:, :, chosen]
        stacked, used = self.stack.evaluate(T), self.stack.used
        pose = np.broadcast_to(np.arange(len(T))[:, None], used.shape)[used]
        C = self.stack.covariance(T)
        same = pose[:, None] == pose[None, :]
        place = np.broadcast_to(np.arange(used.shape[1]), used.shape)[used]
        unit = np.where(same, C[pose[:, None], place[:, None], place[None, :]], 0.0) / ASSUMED_TOUCH**2
        A = (stacked.B @ every)[used]
        return Equations(-stacked.r[used], A, stacked.B[used], pose.astype(np.int64), unit)

    def retract(self, state: _State, step: Array, chosen: NDArray[np.int64]) -> _State:
        whole = np.zeros(len(self.names))
        whole[chosen] = step
        n = len(state.offset)
        return _State(
            state.offset + whole[12 : 12 + n],
            state.reversal + whole[12 + n :],
            retract(state.world_T_base, whole[:6]),
            retract(state.flange_T_tool, whole[6:12]),
        )


def master(
    robot: CalibratedRobot,
    log: JointLog,
    observations: Sequence[Observations],
    *,
    joints: Sequence[str] | None = None,
    free: Sequence[str] = (),
    stated: bool = True,
) -> Mastering:
    """Zero offsets of a calibrated robot from measured poses.

    Parameters
    ----------
    log : the measured poses; approach directions count only where they were recorded.
    joints : names of the joints to master; default all.
    free : 'base' and 'tool' where they are others than those of the calibration (the instrument, or what it measures).
    stated : the measurements state their covariance; else its size is estimated.

    Raises
    ------
    InvalidInput : an unknown joint. NotIdentifiable : the measurements tell none of the offsets.
    """
    known = [f.name for f in robot.model.joints]
    unknown = [name for name in joints or () if name not in known]
    if unknown:
        raise InvalidInput(f"the robot has no joint '{unknown[0]}': its joints are {', '.join(known)}")
    kernel, approach = robot.kernel, log.as_stated().approach
    inputs = robot.inputs(log)
    reference = with_fitted_cell(kernel, inputs, observations, anew=True) if free else kernel.model
    problem = _Problem(kernel, inputs, approach, observations)
    start = _start(kernel, reference, free)
    wanted = _wanted(problem, known, joints, free, approach)
    carried = _held(robot, problem, start, free)
    chosen, gone = _distinguishable(problem, start, carried, wanted)
    if not any(problem.names[k] in known for k in chosen):
        raise NotIdentifiable("the measurements tell none of the offsets: measure more targets, or more poses")

    def solved(sigma: float | None) -> tuple[_State, Adjusted]:
        return adjust(
            lambda s: problem.equations(s, chosen), lambda s, x: problem.retract(s, x, chosen), start, carried, sigma
        )

    state, adjusted = solved(ASSUMED_TOUCH if stated else None)
    p_value = global_test(0.5 * adjusted.sigma0**2 * adjusted.redundancy, adjusted.redundancy)[1]
    if stated and p_value < CONTRADICTED:
        state, adjusted = solved(None)
    return _mastering(robot, _Solved(problem, state, adjusted, chosen, carried), gone, log, p_value)


def _start(kernel: Kernel, reference: object, free: Sequence[str]) -> _State:
    theta = dict(zip(kernel.names, kernel.theta0, strict=True))
    ends = {}
    for end, own in (("base", kernel.world_T_base), ("tool", kernel.flange_T_tool)):
        attribute = "world_T_base" if end == "base" else "flange_T_tool"
        found = getattr(reference, attribute) if end in free else own
        ends[attribute] = found
        if end in free and any(theta[f"{end}.{kind}"] for kind in GEOMETRIC_KINDS):
            deviation = frame_from_xyzrpy([theta[f"{end}.{kind}"] for kind in GEOMETRIC_KINDS])
            ends[attribute] = found @ np.linalg.inv(deviation)  # the kernel adds it again
    n = kernel.model.n_joints
    return _State(np.zeros(n), np.zeros(n), **ends)


def _wanted(
    problem: _Problem, known: Sequence[str], joints: Sequence[str] | None, free: Sequence[str], approach: Array
) -> NDArray[np.int64]:
    """Numbers of the unknowns, in order of preference."""
    chosen = [k for k, name in enumerate(problem.names) if name.split(".")[0] in free]
    mastered = known if joints is None else joints
    both = np.logical_and((approach > 0).any(axis=0), (approach < 0).any(axis=0)).tolist()
    n = len(known)
    chosen += [12 + k for k in range(n) if known[k] in mastered]
    chosen += [12 + n + k for k in range(n) if known[k] in mastered and both[k]]
    return np.array(chosen, dtype=np.int64)


def _held(robot: CalibratedRobot, problem: _Problem, start: _State, free: Sequence[str]) -> CarriedFrames:
    """The tool at the poses with the errors of everything that is held."""
    kernel, inputs = problem.at(start)
    keep = [i for i, name in enumerate(robot.names) if name.split(".")[0] not in free]
    T, J = kernel.frames_and_jacobian(kernel.theta0, inputs, robot.columns[keep])
    moved = kernel.joint_jacobian(kernel.theta0, inputs) * np.asarray(robot.joint_sigma)
    names = tuple(robot.names[i] for i in keep)
    return CarriedFrames(T, names, robot.covariance[np.ix_(keep, keep)], J, moved @ np.swapaxes(moved, 1, 2))


def _distinguishable(
    problem: _Problem, start: _State, carried: CarriedFrames, wanted: NDArray[np.int64]
) -> tuple[NDArray[np.int64], list[tuple[Eliminated, list[str]]]]:
    """Unknowns that the measurements tell apart, and the others with what they are tied to."""
    at = problem.equations(start, wanted)
    H = np.einsum("mi,mik->mk", at.B, carried.J[at.touch])
    same = at.touch[:, None] == at.touch[None, :]
    scatter = np.where(same, np.einsum("mi,mij->mj", at.B, carried.scatter[at.touch]) @ at.B.T, 0.0)
    V = ASSUMED_TOUCH**2 * np.asarray(at.unit) + scatter + H @ carried.covariance @ H.T
    N = at.A.T @ np.linalg.solve(V, at.A)
    names = [problem.names[k] for k in wanted]
    limits = np.array([np.inf if k < 12 else WEAKEST for k in wanted])
    kept, gone = split_dependent(N, names, limits)
    size = dict(zip(names, np.sqrt(np.diag(N)), strict=True))
    reported = []
    for e in gone:
        shares = {name: abs(value) * size[name] for name, value in e.tied_to.items()}
        strong = [name for name, share in shares.items() if share > STRONG_TIE * max(shares.values())]
        reported.append((e, [name.replace(".", " ") for name in strong]))
    return wanted[kept], reported


@dataclass(frozen=True)
class _Solved:
    """The adjusted state; ``chosen`` are the unknowns of the problem that it solved for."""

    problem: _Problem
    state: _State
    adjusted: Adjusted
    chosen: NDArray[np.int64]
    carried: CarriedFrames

    @property
    def names(self) -> list[str]:
        """Of the unknowns that were solved for."""
        return [self.problem.names[k] for k in self.chosen]


def _mastering(
    robot: CalibratedRobot, solved: _Solved, gone: list[tuple[Eliminated, list[str]]], log: JointLog, p_value: float
) -> Mastering:
    joints = robot.model.joints
    names, state, adjusted = solved.names, solved.state, solved.adjusted
    by_name = {f.name: i for i, f in enumerate(joints)}
    rows = [i for i, name in enumerate(names) if name in by_name]
    found = tuple(names[i] for i in rows)
    wide = np.sqrt(np.diag(adjusted.covariance)) * student_factor(
        adjusted.covariance, adjusted.of_touches, adjusted.freedom
    )
    sigma = np.sqrt(np.diag(adjusted.covariance))
    reversal = {
        joint: (float(state.reversal[k]), float(sigma[names.index(f"reversal of {joint}")]))
        for joint, k in by_name.items()
        if f"reversal of {joint}" in names
    }
    return Mastering(
        joints=found,
        offsets=np.array([state.offset[by_name[name]] for name in found]),
        covariance=adjusted.covariance[np.ix_(rows, rows)],
        wide=wide[rows],
        unobservable={e.name: tied for e, tied in gone if e.name in by_name},
        reversal=reversal,
        sigma0=adjusted.sigma0,
        redundancy=adjusted.redundancy,
        p_value=p_value,
        robot=_with_offsets(robot, solved, log),
    )


def zero_parameter(joint: Frame) -> str:
    """Name of the parameter that a joint's zero offset adds to, times the joint's sign."""
    return joint.zero_name


def _with_offsets(robot: CalibratedRobot, solved: _Solved, log: JointLog) -> CalibratedRobot:
    """The robot with the offsets among its parameters, and the covariance of all of them together."""
    names, state, adjusted, carried = solved.names, solved.state, solved.adjusted, solved.carried
    model, joints = robot.model, {f.name: (k, f) for k, f in enumerate(robot.model.joints)}
    values = dict(model.parameters)
    new = list(carried.names)
    of_unknown: list[tuple[str, int, float]] = []
    for i, name in enumerate(names):
        if name in joints:
            k, f = joints[name]
            parameter = zero_parameter(f)
            values[parameter] = values.get(parameter, 0.0) + f.zero_sign * float(state.offset[k])
            of_unknown.append((parameter, i, float(f.zero_sign)))
        elif "." in name:
            of_unknown.append((name, i, 1.0))
    new += [name for name, _, _ in of_unknown if name not in new]
    M = np.zeros((len(new), len(carried.names) + len(names)))
    M[: len(carried.names), : len(carried.names)] = np.eye(len(carried.names))
    for name, i, sign in of_unknown:
        M[new.index(name), len(carried.names) + i] += sign
    joint = np.block([[carried.covariance, adjusted.with_robot.T], [adjusted.with_robot, adjusted.covariance]])
    mastered = replace(
        model.with_parameters(values), world_T_base=state.world_T_base, flange_T_tool=state.flange_T_tool
    )
    plain = CalibratedRobot(
        model=mastered,
        names=tuple(new),
        covariance=M @ joint @ M.T,
        covariance_scale=robot.covariance_scale,
        joint_sigma=robot.joint_sigma,
        statics=robot.statics,
        defaults=robot.defaults,
    )
    return plain.with_recording(log, robot.nominal or mastered.nominal())

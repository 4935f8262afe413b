"""All instruments together, linearised where an identification ended: what a small change of anything would do."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from robcal.calibration.identification import IdentifyOptions
from robcal.calibration.instruments.evaluator import JointEvaluator, Part
from robcal.calibration.instruments.result import IdentifiedInstruments
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import Rows
from robcal.calibration.problem import Problem, State, whitening
from robcal.robot.kernel import Kernel
from robcal.robot.model import RobotModel
from robcal.transforms import Array


@dataclass(frozen=True)
class LinearInstruments:
    """Residuals and derivatives of every instrument's measurements at an identified robot.

    Attributes
    ----------
    names, values : (p,) parameters and how far they are from what is given (SI); of wires from nothing.
    residual, jacobian : (n, D) and (n, D, p), whitened, by stop of the robot and instrument; zero where padded.
    plain, plain_jacobian : the same in the units of the measurements (m, rad).
    spatial : (n, D) which of these are positions or lengths. pose : (n,) rows of the joint log.
    prior, prior_residual : (k, p) and (k,) rows of what is expected, whitened.
    """

    names: tuple[str, ...]
    values: Array
    residual: Array = field(repr=False)
    jacobian: Array = field(repr=False)
    plain: Array = field(repr=False)
    plain_jacobian: Array = field(repr=False)
    spatial: Array = field(repr=False)
    pose: Rows = field(repr=False)
    prior: Array = field(repr=False)
    prior_residual: Array = field(repr=False)


def linearised(
    model: RobotModel,
    found: IdentifiedInstruments,
    log: JointLog,
    options: IdentifyOptions,
    wires: Mapping[str, tuple[str, ...]] | None = None,
) -> LinearInstruments:
    """The measurements that ``found`` was identified from, those left out as blunders aside, at its parameters.

    Parameters
    ----------
    model : the robot that ``found`` was identified from.
    wires : by instrument, parameters of its wire to be free beside those that were identified.
    """
    taking_part = [p for p in found.placed.values() if p.robot is not None]
    robot = found.placed[found.leading].robot
    assert robot is not None
    kernel = Kernel(replace(robot.model, world_T_base=None, flange_T_tool=None), options.statics)
    inputs, wires = log.inputs(kernel), wires or {}
    parts = []
    for p in taking_part:
        i = p.instrument
        free = tuple(dict.fromkeys((*i.wire, *wires.get(i.name, ()))))
        parts.append(Part(i.name, inputs.subset(p.sound), i.recording.select(p.sound), i.world, i.tool, free))
    evaluator = JointEvaluator(kernel, parts)
    at = {p.instrument.world.name: p.world_T_base for p in taking_part}
    tool = {p.instrument.tool.name: p.flange_T_tool for p in taking_part}
    state = State(
        evaluator.theta0.copy(),
        np.array([at[w.name] for w in evaluator.worlds]),
        np.array([tool[t.name] for t in evaluator.tools]),
    )
    before = Kernel(replace(model, world_T_base=None, flange_T_tool=None), options.statics)
    start = dict(zip(before.names, before.theta0, strict=True))
    evaluator.theta0[: len(kernel.names)] = [start.get(n, 0.0) for n in kernel.names]
    added = [f"{name}.wire.{kind}" for name, kinds in wires.items() for kind in kinds]
    names = tuple(dict.fromkeys((*found.names, *added)))
    columns = [evaluator.index[n] for n in names]
    stated = {**options.priors, **{n: s for end in evaluator.cell for n, s in end.priors.items()}}
    priors = {evaluator.index[n]: s for n, s in stated.items()}
    problem = Problem(evaluator, columns, whitening(evaluator, state, options.joint_sigma), None, priors)
    residual, jacobian = problem.blocks(state)
    as_measured = np.broadcast_to(np.eye(residual.shape[1]), problem.whitener.shape)
    plain, plain_jacobian = Problem(evaluator, columns, as_measured).blocks(state)
    rows, width = problem.linearise(state), len(problem.prior)
    return LinearInstruments(
        names,
        np.where(_of_wires(names), state.theta[columns], evaluator.deviations(state)[columns]),
        residual,
        jacobian,
        plain,
        plain_jacobian,
        _spatial(evaluator),
        np.concatenate([p.sound for p in taking_part]),
        rows[1][len(rows[1]) - width :],
        rows[0][len(rows[0]) - width :],
    )


def _of_wires(names: tuple[str, ...]) -> Array:
    return np.array([".wire." in n for n in names], dtype=bool)


def _spatial(evaluator: JointEvaluator) -> Array:
    """Which rows (n, D) of the stack are positions or lengths, not turns."""
    out = np.zeros(evaluator.stack.used.shape, dtype=bool)
    for o, (pose, slot) in zip(evaluator.stack.observations, evaluator.stack.slots, strict=True):
        out[pose[:, None], slot[:, : min(o.dimension, 3)]] = True
    return out

"""Identification of one robot from several instruments: each has a world, a tool and a noise of its own."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robcal.calibration.identifiability import Candidates, check_poses, choose_candidates
from robcal.calibration.identification import IdentifyOptions, estimate
from robcal.calibration.instruments.assembly import Found, assembled
from robcal.calibration.instruments.components import LEVEL, Component, components, reweighted, settled
from robcal.calibration.instruments.evaluator import JointEvaluator, Part, kernel_ends
from robcal.calibration.instruments.instrument import Instrument
from robcal.calibration.instruments.placing import Placement, place
from robcal.calibration.instruments.result import IdentifiedInstruments
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import Rows
from robcal.calibration.problem import State
from robcal.calibration.solution import Engine
from robcal.errors import InvalidInput
from robcal.robot.kernel import Kernel
from robcal.robot.model import RobotModel
from robcal.transforms import Array

ROUNDS = 5
"""Most estimations until the variance components are settled."""


@dataclass(frozen=True)
class _Task:
    """The instruments that take part, by name, and their rows in the joint log."""

    kernel: Kernel
    log: JointLog
    rows: dict[str, Rows]

    def evaluator(self, instruments: Sequence[Instrument]) -> JointEvaluator:
        inputs = self.log.inputs(self.kernel)
        return JointEvaluator(
            self.kernel,
            [
                Part(i.name, inputs.subset(rows), i.recording.select(rows), i.world, i.tool, i.wire)
                for i in instruments
                if len(rows := self.rows[i.name])
            ],
        )


def identify_instruments(
    model: RobotModel, log: JointLog, instruments: Sequence[Instrument], options: IdentifyOptions | None = None
) -> IdentifiedInstruments:
    """Identify a robot from all instruments that measured poses which are not kept out.

    Instruments that measured kept-out poses only are placed on the identified robot by these very poses.

    Raises
    ------
    InvalidInput : nothing to identify from, or gravity given in a world while there are several.
    NotIdentifiable : fewer measurements than unknowns, or an instrument that cannot be placed.
    """
    clock = time.perf_counter()
    options = options or IdentifyOptions()
    rows = {i.name: np.array([k for k in i.recording.poses if not log.verify[k]], dtype=np.int64) for i in instruments}
    taking_part = [i for i in instruments if len(rows[i.name])]
    if not taking_part:
        raise InvalidInput("no measured pose is left to identify from: set 'identify' in the column set")
    _check_gravity(model, instruments)
    kernel = Kernel(model, options.statics)
    task = _Task(kernel, log, rows)
    evaluator = task.evaluator(taking_part)
    check_poses(evaluator.poses.q, evaluator.stack.rows, ())
    state = start(evaluator)
    choice = _candidates(model, options, evaluator)
    variance = {i.name: 1.0 for i in instruments}
    stated_by: dict[str, Component] = {}
    iterations = 0
    for _ in range(ROUNDS):
        engine = Engine(evaluator, choice, options.joint_sigma, _priors(evaluator, options), options.termination)
        solution, weights, outliers, statistics = estimate(engine, state, options.robust, evaluator.rows)
        iterations += solution.iterations
        each = components(evaluator, solution.state, weights, statistics)
        found = {part.name: component for part, component in zip(evaluator.parts, each, strict=True)}
        stated_by = stated_by or found
        taking_part, changed = _with_new_weights(taking_part, found, variance, options)
        if not changed:
            break
        evaluator, state = task.evaluator(taking_part), solution.state
    result = Found(
        engine, evaluator, solution, weights, tuple(outliers), statistics, found, stated_by, variance, options
    )
    seconds = time.perf_counter() - clock
    return assembled(replace(result, iterations=iterations, seconds=seconds), log, rows, taking_part, instruments)


def start(evaluator: JointEvaluator) -> State:
    """Worlds and tools constructed on the nominal robot, those of the instruments that tell most first."""
    chain = evaluator.kernel.with_references(np.eye(4), np.eye(4))
    theta = evaluator.theta0[: len(evaluator.kernel.names)]
    located: dict[str, Array] = {}
    order = sorted(evaluator.parts, key=lambda p: (-max(o.dimension for o in p.observations), -len(p.poses)))
    for part in order:
        found: Placement = place(part, chain.frames(theta, part.poses), located)
        located.setdefault(part.world.parameter_names[0], found.world_T_base)
        located.setdefault(part.tool.parameter_names[0], found.flange_T_tool)
    frames = [np.array([located[e.parameter_names[0]] for e in ends]) for ends in (evaluator.worlds, evaluator.tools)]
    return State(evaluator.theta0.copy(), *frames)


def _candidates(model: RobotModel, options: IdentifyOptions, evaluator: JointEvaluator) -> Candidates:
    chosen = choose_candidates(model, options.parameters)
    ends = [name for end in evaluator.cell for name in end.unknown]
    robot = [name for name in chosen.forced if name not in kernel_ends()]
    for name in (*robot, *options.priors):
        if name not in evaluator.index:
            raise InvalidInput(f"robot '{model.name}' has no parameter '{name}'")
    wires = [name for part in evaluator.parts for name in part.wire_names]
    return replace(chosen, forced=(*ends, *robot, *wires))


def _priors(evaluator: JointEvaluator, options: IdentifyOptions) -> dict[str, float]:
    return {**options.priors, **{name: sigma for end in evaluator.cell for name, sigma in end.priors.items()}}


def _with_new_weights(
    instruments: Sequence[Instrument], found: dict[str, Component], variance: dict[str, float], options: IdentifyOptions
) -> tuple[list[Instrument], bool]:
    """Instruments weighted as their residuals show, and whether any weight changed; ``variance`` is kept up to date."""
    out, changed = [], False
    for i in instruments:
        component, stated = found[i.name], i.recording.stated
        holds = variance[i.name] == 1.0 and component.p_value >= LEVEL
        trusted = stated and (options.covariance == "stated" or holds)
        even = [np.array([component.sigma0**2])]
        if trusted or settled(even if stated else component.factors):
            out.append(i)
            continue
        recording = i.recording
        observations = reweighted(recording.observations, component, stated)
        pairs = zip(recording.detailed, recording.observations, observations, strict=True)
        detailed = tuple(new if own is old else own for own, old, new in pairs)
        out.append(replace(i, recording=replace(recording, observations=observations, detailed=detailed)))
        variance[i.name] *= component.sigma0**2
        changed = True
    return out, changed


def _check_gravity(model: RobotModel, instruments: Sequence[Instrument]) -> None:
    if model.gravity_frame == "world" and len({i.world.name for i in instruments}) > 1:
        raise InvalidInput(
            f"robot '{model.name}' has gravity_frame: world, and the instruments have {len(instruments)} worlds: give "
            "gravity_m_s2 in base coordinates"
        )

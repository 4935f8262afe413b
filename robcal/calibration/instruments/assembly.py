"""From a solution over all instruments to a robot for each of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from robcal.calibration.identifiability import observability_indices
from robcal.calibration.identification import IdentifiedRobot, IdentifyOptions
from robcal.calibration.instruments.components import Component
from robcal.calibration.instruments.evaluator import JointEvaluator, Part, kernel_ends
from robcal.calibration.instruments.instrument import Instrument
from robcal.calibration.instruments.placing import coordinate_title, place
from robcal.calibration.instruments.result import IdentifiedInstruments, PlacedInstrument
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import Rows
from robcal.calibration.outliers import PoseStatistics
from robcal.calibration.problem import joint_scatter
from robcal.calibration.solution import Engine, Solution
from robcal.calibration.verification import fit_nominal
from robcal.errors import NotIdentifiable
from robcal.estimation.covariance import LinearStatistics, global_test, linear_statistics
from robcal.estimation.dependence import Eliminated
from robcal.robot.kernel import Kernel
from robcal.robot.model import RobotModel
from robcal.transforms import Array, transport_covariance


@dataclass(frozen=True)
class Found:
    """Where the estimation ended.

    Attributes
    ----------
    weights : (n,) of the rows of the evaluator; outliers : those left out.
    components : by instrument, against the last weights; stated : against what it states; variance : of both.
    """

    engine: Engine
    evaluator: JointEvaluator
    solution: Solution
    weights: Array
    outliers: tuple[int, ...]
    poses: PoseStatistics
    components: Mapping[str, Component]
    stated: Mapping[str, Component]
    variance: Mapping[str, float]
    options: IdentifyOptions
    iterations: int = 0
    seconds: float = 0.0
    statistics: LinearStatistics = field(init=False)

    def __post_init__(self) -> None:
        J = self.solution.problem.linearise(self.solution.state)[1]
        object.__setattr__(self, "statistics", linear_statistics(J))

    @property
    def model(self) -> RobotModel:
        """The robot with its parameters, without base and tool."""
        kernel = self.engine.kernel
        theta = self.solution.state.theta[: len(kernel.names)]
        return kernel.model.with_parameters({n: float(v) for n, v in zip(kernel.names, theta, strict=True)})


def assembled(
    found: Found, log: JointLog, rows: Mapping[str, Rows], taking_part: Sequence[Instrument], all_: Sequence[Instrument]
) -> IdentifiedInstruments:
    """All instruments with their worlds and tools, and the robot as each sees it."""
    redundancy = _redundancy(found)
    sigma0, p_value = global_test(found.solution.summary.cost, redundancy)
    weighted = {i.name: i for i in taking_part}
    parts = {p.name: k for k, p in enumerate(found.evaluator.parts)}
    placed: dict[str, PlacedInstrument] = {}
    notes: list[str] = []
    for i in sorted(all_, key=lambda i: i.name not in parts):
        if i.name in parts:
            placed[i.name] = _identified(
                found, parts[i.name], weighted[i.name], rows[i.name], log, (sigma0, redundancy, p_value)
            )
        else:
            placed[i.name] = _verifying(found, i, log, placed)
            notes.append(
                f"instrument '{i.name}' measured kept-out poses only: its world and tool are fitted to these very poses"
            )
    return IdentifiedInstruments(
        {i.name: placed[i.name] for i in all_}, found.solution.names, found.statistics.cofactor, tuple(notes)
    )


def _redundancy(found: Found) -> int:
    rows = int(found.weights.astype(bool) @ found.engine.stack.used.sum(axis=1))
    redundancy = rows + len(found.solution.problem.prior) - len(found.solution.names)
    if redundancy < 0:
        raise NotIdentifiable(
            f"{rows} measured numbers cannot determine {len(found.solution.names)} parameters: measure more poses or "
            "choose fewer parameters",
            found.solution.names,
        )
    return redundancy


def _identified(
    found: Found, part: int, instrument: Instrument, rows: Rows, log: JointLog, test: tuple[float, int, float]
) -> PlacedInstrument:
    evaluator = found.evaluator
    instrument = _as_identified(found, part, instrument)
    mine = evaluator.rows[part]
    W, F = evaluator.placed(found.solution.state, part)
    own = evaluator.parts[part]
    titles = dict(zip((*own.world.parameter_names, *own.tool.parameter_names), kernel_ends(), strict=True))
    names, covariance = _own_parameters(found, part, titles)
    component, stated = found.components[instrument.name], found.stated[instrument.name]
    used = found.weights[mine] > 0
    others = set(evaluator.index) - set(evaluator.kernel.names) - set(titles)
    robot = IdentifiedRobot(
        model=replace(found.model, world_T_base=W, flange_T_tool=F),
        names=names,
        statics=found.options.statics,
        joint_sigma=found.options.joint_sigma or 0.0,
        covariance=covariance,
        covariance_scale=1.0,
        sigma0=test[0],
        redundancy=test[1],
        p_value=test[2],
        eliminated={
            titles.get(n, n): _renamed(e, titles) for n, e in found.solution.eliminated.items() if n not in others
        },
        rejected_elasticities=found.solution.rejected,
        condition=found.statistics.condition,
        condition_raw=found.statistics.condition_raw,
        correlations=_correlations(covariance),
        observability=observability_indices(found.statistics.singular_values),
        residuals=found.poses.residuals[mine],
        normalised=np.sqrt(found.poses.mean_square[mine]),
        leverage=found.poses.leverage[mine],
        redundancy_numbers=found.poses.redundancy[mine],
        outliers=tuple(np.flatnonzero(~used).tolist()),
        used=used,
        options=found.options,
        first_summary=found.solution.first,
        summary=found.solution.summary,
        iterations=found.iterations,
        seconds=found.seconds,
    )
    sound = rows[used]
    inputs = log.inputs(robot.kernel).subset(sound)
    bare = replace(found.engine.kernel.model.nominal(), world_T_base=W, flange_T_tool=F)
    if not instrument.loop:
        bare = fit_nominal(found.engine.kernel.model, inputs, instrument.recording.select(sound)).model
    held = tuple(coordinate_title(n) for n in titles if n in found.solution.eliminated)
    held += tuple(f"wire.{k}" for k, n in zip(own.wire, own.wire_names, strict=True) if n in found.solution.eliminated)
    return PlacedInstrument(
        instrument,
        rows,
        used,
        stated.sigma0 if instrument.recording.stated else component.sigma0,
        component.redundancy,
        stated.p_value if instrument.recording.stated else component.p_value,
        found.variance[instrument.name],
        W,
        F,
        _cell_block(names, covariance),
        held,
        bare,
        robot.with_recording(log, bare),
        _wire(found, own),
    )


def _wire(found: Found, own: Part) -> dict[str, tuple[float, float]]:
    """Identified parameters of a wire and their standard deviations."""
    sigma = dict(zip(found.solution.names, np.sqrt(np.diag(found.statistics.cofactor)).tolist(), strict=True))
    theta, index = found.solution.state.theta, found.evaluator.index
    names = zip(own.wire, own.wire_names, strict=True)
    return {kind: (float(theta[index[n]]), sigma[n]) for kind, n in names if n in sigma}


def _as_identified(found: Found, part: int, instrument: Instrument) -> Instrument:
    """The instrument with its measurements, those kept out as well, seen through the identified wire."""
    own, theta = found.evaluator.parts[part], found.solution.state.theta
    if not own.wire:
        return instrument
    values = theta[[found.evaluator.index[n] for n in own.wire_names]]
    recording = instrument.recording
    observations, detailed = (
        replace(own, observations=some).with_wire(values) for some in (recording.observations, recording.detailed)
    )
    return replace(instrument, recording=replace(recording, observations=observations, detailed=detailed))


def _renamed(e: Eliminated, titles: Mapping[str, str]) -> Eliminated:
    return replace(e, name=titles.get(e.name, e.name), tied_to={titles.get(n, n): v for n, v in e.tied_to.items()})


def _own_parameters(found: Found, part: int, titles: Mapping[str, str]) -> tuple[tuple[str, ...], Array]:
    """Names and covariance of the robot's parameters and of one instrument's base and tool, as right perturbations."""
    names = found.solution.names
    robot = [k for k, n in enumerate(names) if n in found.evaluator.kernel.index]
    order = {n: k for k, n in enumerate(titles)}
    cell = [k for k, n in enumerate(names) if n in order]
    at = [*(len(robot) + order[names[k]] for k in cell)]
    full = np.zeros((len(robot) + 12, len(robot) + 12))
    chosen, where = [*robot, *cell], [*range(len(robot)), *at]
    full[np.ix_(where, where)] = found.statistics.cofactor[np.ix_(chosen, chosen)]
    turn = np.eye(len(full))
    turn[len(robot) :, len(robot) :] = found.evaluator.to_right_twists(found.solution.state, part)
    full = transport_covariance(turn, full)
    reported = [*range(len(robot)), *(len(robot) + k for k in range(12) if full[len(robot) + k, len(robot) + k] > 0)]
    labels = (*(names[k] for k in robot), *kernel_ends())
    return tuple(labels[k] for k in reported), full[np.ix_(reported, reported)]


def _cell_block(names: Sequence[str], covariance: Array) -> Array:
    """Covariance (12, 12) of base and tool, zero where they are held."""
    at = [(k, kernel_ends().index(n)) for k, n in enumerate(names) if n in kernel_ends()]
    out = np.zeros((12, 12))
    if at:
        inside, place_ = (list(v) for v in zip(*at, strict=True))
        out[np.ix_(place_, place_)] = covariance[np.ix_(inside, inside)]
    return out


def _correlations(covariance: Array) -> Array:
    sigma = np.sqrt(np.diag(covariance))
    return np.asarray(covariance / np.outer(sigma, sigma))


def _verifying(
    found: Found, instrument: Instrument, log: JointLog, others: Mapping[str, PlacedInstrument]
) -> PlacedInstrument:
    """An instrument placed on the identified robot by its kept-out poses."""
    kernel = Kernel(replace(found.model, world_T_base=None, flange_T_tool=None), found.options.statics)
    rows = instrument.recording.poses
    part = Part(
        instrument.name,
        log.inputs(kernel).subset(rows),
        instrument.recording.select(rows),
        instrument.world,
        instrument.tool,
    )
    located = {}
    for other in others.values():
        located[other.instrument.world.parameter_names[0]] = other.world_T_base
        located[other.instrument.tool.parameter_names[0]] = other.flange_T_tool
    scatter = None
    if found.options.joint_sigma is not None:
        state = replace(found.solution.state, world_T_base=np.eye(4), flange_T_tool=np.eye(4), theta=kernel.theta0)
        scatter = joint_scatter(kernel, state, part.poses, found.options.joint_sigma)
    at = place(part, kernel.frames(kernel.theta0, part.poses), located, scatter=scatter)
    bare = replace(found.engine.kernel.model.nominal(), world_T_base=at.world_T_base, flange_T_tool=at.flange_T_tool)
    if not instrument.loop:
        bare = fit_nominal(found.engine.kernel.model, part.poses, part.observations).model
    nobody = np.zeros(0, dtype=np.int64)
    return PlacedInstrument(
        instrument,
        nobody,
        np.zeros(0, dtype=bool),
        float("nan"),
        0.0,
        float("nan"),
        1.0,
        at.world_T_base,
        at.flange_T_tool,
        at.covariance,
        at.held,
        bare,
    )

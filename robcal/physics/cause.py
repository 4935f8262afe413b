"""Causes whose law is linear in its parameters (amplitudes), at one place each, and the entries of the library.

Constants that bend a law (an order, the pose of a jump, a torque scale, a time constant) come from a grid, and the
continuous ones among them may be refined between the grid's values. Causes of the robot act through its kernel: `bases`
names expressions of the robot's variables that are added to a number of a frame. Causes of observations displace what
was measured: `observation_shift` gives the displacement of every observation per unit of each parameter.

Sizes that deviations of robots usually have: the measure of priors, steps, and doubts about what is held.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robcal.calibration.wire import Wire
from robcal.cause import Cause, Kind, describe
from robcal.robot.terms import evaluate, identifier

Array = NDArray[Any]
"""Real numbers, indices or masks: the diagnosis handles all three."""
Constants = Mapping[str, float]
Report = Callable[[Array, Constants], dict[str, object]]
Key = tuple[Kind, str, str | None, tuple[str, ...]]

DEG = float(np.degrees(1.0))
PER_KNM = DEG * 1e3
"""rad/(N m) to deg/(kN m)."""


@dataclass(frozen=True)
class Basis:
    """`parameter * expression` is added to the `kind` (q, x .. yaw) of `frame`.

    The expression is a template with names for its constants: a template is read once, however many constants a scan
    tries.
    """

    frame: str
    kind: str
    template: str
    parameter: str
    constants: Constants = field(default_factory=dict)

    @property
    def expression(self) -> str:
        """The expression with its constants filled in, as a term of the kernel wants it."""
        if not self.constants:
            return self.template
        names = "|".join(map(re.escape, self.constants))
        return re.sub(rf"\b({names})\b", lambda found: f"({float(self.constants[found[0]])!r})", self.template)

    def value(self, variables: Mapping[str, Array]) -> Array:
        """Value of the expression at the variables."""
        return evaluate(self.template, {**variables, **self.constants})


@dataclass(frozen=True)
class ObservationData:
    """What causes of observations may need: one row per observation, in the order of the residuals.

    Attributes
    ----------
    kind : 'frames' (six numbers a row), 'points' (three), 'distances' (one), 'sensor' (three, mapped to the world).
    pose : (m,) row of the pose of each observation.
    target : (m,) id of the target, -1 for frames and distances.
    world_T_tool : (m, 4, 4) modelled frame of the tool at each observation.
    p_tool : (m, 3) modelled coordinates of the target in the tool (zeros for frames).
    p_world : (m, 3) modelled position in the measuring system.
    p_sensor : (m, 3) measured coordinates in the sensor, if there is one. wire : of distances, how they are counted.
    variables : per pose, the covariates (time_s, temp_*, index ...) and the kernel's variables, each (n,).
    """

    kind: str
    pose: Array
    target: Array
    world_T_tool: Array
    p_tool: Array
    p_world: Array
    p_sensor: Array | None
    variables: Mapping[str, Array]
    wire: Wire = field(default_factory=Wire)


@dataclass(frozen=True)
class LinearCause(Cause):
    """One cause at one place, with a law.

    Attributes
    ----------
    parameters : short names of the amplitudes, the order of the columns.
    priors : typical size of each amplitude (SI), the standard deviation of its prior.
    report : amplitudes (SI) and constants to the reported parameters with their units.
    sentence : template for people in place of the kind's.
    grid : values of the constants to be tried.
    continuous : constants that may be refined, with their bounds.
    ordered : constants with a long list of values of which the grid holds a part; refined among the values nearby.
    positive : prior probability that the amplitude is positive (one parameter only): things deflect and grow, rarely
        the reverse.
    limits : lowest and highest amplitude that can be. known_within : largest standard deviation of the first one with
        which the data say anything of it.
    weight : prior weight (a kind that may act at many places shares one weight among them).
    covariates : variables that the law follows.
    default_prior : typical size of amplitudes whose number depends on the constants.
    free_parameters : parameters the kernel has already, which the cause sets free (order of `parameters`).
    jointly_fitted : parameters of the kernel that are fitted anyway and reported with the cause: reported name to
        kernel name and factor to the reported unit.
    scaled_by : parameter of the kernel by which the law multiplies its amplitudes, and the value that stands in the
        law: amplitudes are reported for the value that the parameter has in the end.
    """

    parameters: tuple[str, ...]
    priors: tuple[float, ...]
    report: Report
    sentence: str = ""
    grid: tuple[Constants, ...] = ({},)
    continuous: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    ordered: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    positive: float = 0.5
    limits: tuple[float, float] = (-np.inf, np.inf)
    known_within: float = np.inf
    weight: float = 1.0
    covariates: tuple[str, ...] = ()
    default_prior: float = 1.5e-4
    free_parameters: tuple[str, ...] = ()
    jointly_fitted: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    scaled_by: tuple[str, float] | None = None

    def laws(self, constants: Constants) -> tuple[Basis, ...]:
        """Expressions that are added to numbers of the robot's frames; none unless it is a cause of the robot."""
        return ()

    def names(self, constants: Constants) -> tuple[str, ...]:
        """Amplitudes in column order."""
        return self.parameters

    def sizes(self, constants: Constants) -> Array:
        """Typical amplitude of each column."""
        return np.array(self.priors) if self.priors else np.full(len(self.names(constants)), self.default_prior)

    def describe(self, reported: Mapping[str, object]) -> str:
        """The sentence for reported parameters."""
        return describe(self.sentence or self.kind.sentence, self.where, self.direction, reported)

    @property
    def key(self) -> Key:
        """What makes the cause one of its kind; an axis may be dragged along by several others, so a coupling's
        driving axis belongs to it."""
        return (self.kind, self.where, self.direction, self.covariates if self.kind.several_drivers else ())

    @property
    def of_order(self) -> bool:
        """Whether it is bound to the order or the time of the poses."""
        return self.kind.of_order or not {"index", "time_s"}.isdisjoint(self.covariates)

    @property
    def acts_once(self) -> bool:
        """Whether a place has such a cause at most once: its constants bend one law (a threshold, a torque scale, a
        time constant), while jumps at several poses and waves of several orders may add up."""
        return len(self.grid) == 1 or bool(self.continuous) or bool(self.ordered and not self.kind.of_order)


@dataclass(frozen=True)
class RobotCause(LinearCause):
    """A cause that changes the robot: `bases` gives the expressions that are added to numbers of frames."""

    bases: Callable[[Constants], tuple[Basis, ...]] | None = None

    def laws(self, constants: Constants) -> tuple[Basis, ...]:
        """Expressions that are added to numbers of frames."""
        return () if self.bases is None else self.bases(constants)

    def names(self, constants: Constants) -> tuple[str, ...]:
        """Amplitudes in column order; where their number depends on the constants they are read from the laws."""
        return self.parameters or tuple(dict.fromkeys(basis.parameter for basis in self.laws(constants)))


@dataclass(frozen=True)
class ObservationCause(LinearCause):
    """A cause that displaces observations: (data, constants) to displacements (m, k, parameters)."""

    observation_shift: Callable[[ObservationData, Constants], Array] = field(kw_only=True)


@dataclass(frozen=True)
class Entry:
    """An entry of the library: causes and the places where they may act.

    Attributes
    ----------
    on_robot : a robot's site to the causes that may act there.
    on_observations : observations, ids of the body's targets and its name to the causes that may show in them.
    """

    on_robot: Callable[[Any], Iterable[RobotCause]] | None = None
    on_observations: Callable[[ObservationData, tuple[int, ...], str], Iterable[ObservationCause]] | None = None


def amplitude_phase(values: Array, factor: float = DEG) -> tuple[float, float]:
    """Amplitude of a wave, ``values`` (2,) of cosine and sine, times ``factor``, and its phase in degrees."""
    return float(np.hypot(*values) * factor), float(np.degrees(np.arctan2(values[1], values[0])))


def report_wave(values: Array, constants: Constants) -> dict[str, object]:
    """Order, amplitude and phase (deg) of a wave; whole orders as whole numbers."""
    amplitude, phase = amplitude_phase(values)
    order, nearest = constants["order"], round(constants["order"])
    whole = abs(order - nearest) < 1e-6
    return {"order": nearest if whole else order, "amplitude_deg": amplitude, "phase_deg": phase}


def report_move(values: Array, constants: Constants) -> dict[str, object]:
    """Pose from which on something stands elsewhere, its shift and its turn from ``values`` (6,), m and rad."""
    shift, turn = [float(x) * 1e3 for x in values[:3]], [float(x) * DEG for x in values[3:]]
    return {"pose": constants["pose"], "shift_mm": shift, "turn_deg": turn}


def numeric_sigma(
    report: Report, values: Array, constants: Constants, covariance: Array
) -> tuple[dict[str, object], dict[str, object]]:
    """Reported parameters and their standard deviations by first-order propagation (central differences).

    Text and constants are passed through without a sigma. Weakness: an amplitude near zero has a skew distribution
    that a standard deviation does not tell.
    """
    reported = report(values, constants)
    numbers = [name for name, value in reported.items() if isinstance(value, (float, list)) and name not in constants]
    flat = {name: np.atleast_1d(np.asarray(reported[name], dtype=float)) for name in numbers}
    spread = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    slopes: dict[str, list[Array]] = {name: [] for name in numbers}
    for k, size in enumerate(spread):
        step = np.zeros_like(values)
        step[k] = 1e-3 * size if size > 0 else 1e-12
        up, down = report(values + step, constants), report(values - step, constants)
        for name in numbers:
            change = np.atleast_1d(np.asarray(up[name], dtype=float)) - np.atleast_1d(np.asarray(down[name], float))
            if name.startswith(("phase", "azimuth")):
                change = (change + 180.0) % 360.0 - 180.0
            slopes[name].append(change / (2.0 * step[k]))
    sigma: dict[str, object] = {}
    for name in numbers:
        jacobian = np.stack(slopes[name], axis=-1)
        deviations = np.sqrt(np.clip(np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian), 0.0, None))
        sigma[name] = (
            float(deviations[0])
            if len(flat[name]) == 1 and not isinstance(reported[name], list)
            else [float(v) for v in deviations]
        )
    return reported, sigma


DEVIATION = 1e-3
"""m or rad."""
DEFLECTION = 3e-4
"""rad under the largest load of a recording."""
LEAST_MOMENT = 0.1
"""N m; what stays below it carries no load."""


def prior_scale(name: str, variables: Mapping[str, Array]) -> float:
    """Usual size of a deviation (m, rad), or of an elasticity (rad/(N m)) by the deflection under the largest load.

    Zero for anything else (loads, gravity, amplitudes), and for elasticities without a load.
    """
    frame, _, kind = name.rpartition(".")
    if not kind.startswith("elastic_"):
        geometric = kind in ("x", "y", "z", "roll", "pitch", "yaw") and not frame.startswith("payload.")
        return DEVIATION if geometric else 0.0
    moment = variables.get(f"{identifier(frame)}_m{kind.removeprefix('elastic_')}")
    largest = 0.0 if moment is None else float(np.max(np.abs(moment)))
    return DEFLECTION / largest if largest > LEAST_MOMENT else 0.0


def prior_scales(names: Sequence[str], variables: Mapping[str, Array]) -> Array:
    """The same for many names (p,)."""
    return np.array([prior_scale(name, variables) for name in names])

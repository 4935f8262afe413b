"""What is bound to the order of a recording's poses (a station or a base that moved, a zero that jumped) is no law of
the robot: it stays with the recording.

The robot speaks in the measuring system's frame as it was at the first pose, and of its joints as they were after the
last one: a slipped gear stays slipped.
"""

import dataclasses

import numpy as np

from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import RobotObservations, RobotRecording
from robcal.calibration.observations import FrameObservations, PointObservations, SensorPointObservations
from robcal.diagnosis.core.fitting import Fit
from robcal.diagnosis.core.recording import Recording, observation_data
from robcal.physics.cause import ObservationCause
from robcal.robot.kernel_cache import kernel_of
from robcal.robot.model import RobotModel, Term
from robcal.robot.terms import names_in
from robcal.transforms import Array, invert, retract, transform


def of_order(term: Term) -> bool:
    """Whether a term follows the order of the poses."""
    return "index" in names_in(term.expression)


def _into(model: RobotModel, term: Term) -> str | None:
    """The zero into which a jump of a joint goes; None where the term is no such thing."""
    frame = next((f for f in model.frames if f.name == term.frame), None)
    if term.kind != "q" or frame is None or not frame.is_joint:
        return None
    return frame.zero_name


def without_order(model: RobotModel) -> RobotModel:
    """The model without terms that follow the order of the poses; jumps of a joint's zero are in the zero."""
    bound = [term for term in model.terms if of_order(term)]
    signs = {frame.name: frame.zero_sign for frame in model.frames}
    values = dict(model.parameters)
    for term in bound:
        if (zero := _into(model, term)) is not None:
            values[zero] = values.get(zero, 0.0) + signs[term.frame] * sum(term.parameters.values())
    return dataclasses.replace(model, terms=tuple(t for t in model.terms if not of_order(t)), parameters=values)


def covariance_without_order(
    model: RobotModel, names: tuple[str, ...], covariance: Array
) -> tuple[tuple[str, ...], Array]:
    """Names and covariance (p, p) of the parameters of :func:`without_order`'s model."""
    bound = [term for term in model.terms if of_order(term)]
    gone = {name for term in bound for name in term.parameter_names}
    signs = {frame.name: frame.zero_sign for frame in model.frames}
    stay = tuple(name for name in names if name not in gone)
    A = np.array([[float(a == b) for b in names] for a in stay])
    for term in bound:
        if (zero := _into(model, term)) in stay:
            for name in term.parameter_names:
                A[stay.index(str(zero)), names.index(name)] += signs[term.frame]
    return stay, A @ covariance @ A.T


def placed(recording: RobotRecording, log: JointLog, final: Fit) -> RobotRecording | None:
    """The measurements as they would be without what follows the order of the poses; None where nothing does.

    Parameters
    ----------
    final : the fit beside it, its terms not yet left out.
    """
    found = [(a, a.cause) for a in final.accepted if isinstance(a.cause, ObservationCause)]
    moves = [(a, cause) for a, cause in found if cause.of_order]
    if not moves and not any(map(of_order, final.model.terms)):
        return None
    kernel = kernel_of(final.model, "converged")
    bare = kernel_of(without_order(final.model), "converged")
    inputs = log.inputs(kernel)
    T = kernel.frames(kernel.theta0, inputs)
    back = bare.frames(bare.theta0, log.inputs(bare)) @ invert(T)
    variables = kernel.variables(kernel.theta0, inputs)

    def moved(o: RobotObservations) -> RobotObservations:
        data = observation_data(Recording(log.q, log.payload, log.recorded(), log.names, o), T, variables)
        shift = sum((cause.observation_shift(data, a.constants) @ a.values for a, cause in moves), np.zeros(()))
        if isinstance(o, FrameObservations):
            world_T_tool = retract(o.world_T_tool, -shift) if moves else o.world_T_tool
            return dataclasses.replace(o, world_T_tool=back[o.pose] @ world_T_tool)
        if isinstance(o, PointObservations | SensorPointObservations):
            return dataclasses.replace(o, p_world=transform(back[o.pose], o.p_world - shift))
        longer = np.linalg.norm((back @ T)[o.pose, :3, 3], axis=1) - np.linalg.norm(T[o.pose, :3, 3], axis=1)
        return dataclasses.replace(o, distance=o.distance - shift.reshape(-1) + longer)

    observations, detailed = (tuple(moved(o) for o in some) for some in (recording.observations, recording.detailed))
    return dataclasses.replace(recording, observations=observations, detailed=detailed)

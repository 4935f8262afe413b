"""Exchange of a robot: a new one of the same type goes, in the same world, where a calibrated reference robot goes.

The new robot is identified from few poses: zero offsets, base and tool freely, its other deviations with the scatter
that those of the reference show as a prior (empirical Bayes, Robbins 1956), elasticities and loads as the reference has
them. So the data say what they can, and the predicted uncertainty holds what they leave open. Taught poses are then
transferred by the inverse of the new robot at the frames of the reference.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.identification import IdentifiedRobot, IdentifyOptions
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import RobotRecording
from robcal.calibration.observations import Observations
from robcal.calibration.variance_components import identify_recording
from robcal.cell.mastering import Mastering, master
from robcal.errors import InvalidInput
from robcal.robot.compensation import Compensation, compensate
from robcal.robot.kernel import Kernel
from robcal.robot.model import GEOMETRIC_KINDS, RobotModel
from robcal.transforms import Array, difference, transport_covariance

LEAST_LENGTH, LEAST_ANGLE = 5e-5, 5e-5
"""Smallest scatter (m, rad) that deviations of robots are taken to have."""
PLACED = (5e-4, 5e-4)
"""m and rad: how alike two robots of a type stand on the same foundation and hold the same tool."""
FEW = 4
"""Fewer distinct poses than these do not tell base and tool from the zero offsets."""
BELOW_LIMIT = 1.9e-3
"""Largest scatter (m, rad): beyond it a reference robot is no type but a damaged one."""


@dataclass(frozen=True)
class Transfer:
    """Joint values for a new robot.

    Attributes
    ----------
    command : of the compensation; NaN where out of reach.
    sigma : (n,) standard deviation of the distance of both robots' tools, m (root of the trace).
    before : (n,) distance of the tools if the taught angles were driven, m.
    """

    command: Compensation = field(repr=False)
    sigma: Array
    before: Array


def exchange(
    reference: CalibratedRobot, nominal: RobotModel, log: JointLog, recording: RobotRecording
) -> IdentifiedRobot:
    """A new robot of the reference's type, identified in the same world.

    Parameters
    ----------
    nominal : of the new robot; log, recording : its measured poses.

    Raises
    ------
    InvalidInput : a robot of another type. NotIdentifiable : too few measurements for base, tool and zero offsets.
    """
    start = _start(reference, nominal)
    known = reference.model.parameters
    zeros, others = _geometry(nominal)
    options = IdentifyOptions(
        parameters=(*zeros, *others),
        statics=reference.statics,
        priors=type_scatter(known, others),
        joint_sigma=list(np.broadcast_to(np.asarray(reference.joint_sigma, dtype=float), len(zeros)))
        if np.any(reference.joint_sigma)
        else None,
        covariance="auto" if recording.stated else "estimated",
    )
    kernel = Kernel(start, options.statics)
    inputs = log.inputs(kernel)
    found, _ = identify_recording(start, inputs, recording, np.arange(len(log)), options, kernel)
    return found.with_recording(log, nominal)


def exchange_by_mastering(
    reference: CalibratedRobot,
    nominal: RobotModel,
    log: JointLog,
    observations: Sequence[Observations],
    stated: bool = True,
) -> Mastering:
    """A new robot of the reference's type from too few poses for its base and tool: one is enough.

    Zero offsets alone are fitted. Base and tool are the reference's, as well as robots stand on one foundation and hold
    one tool; the geometry is the drawing's, with the scatter of the type. What that leaves open is in the covariance.

    Raises
    ------
    InvalidInput : a robot of another type. NotIdentifiable : the measurements tell no offset.
    """
    start = _start(reference, nominal)
    _, others = _geometry(nominal)
    ends = [f"{end}.{kind}" for end in ("base", "tool") for kind in GEOMETRIC_KINDS]
    scatter = type_scatter(reference.model.parameters, others)
    sizes = np.array([*(scatter[n] for n in others), *np.tile(np.repeat(PLACED, 3), 2)])
    believed = CalibratedRobot(
        model=start,
        names=(*others, *ends),
        covariance=np.diag(sizes**2),
        joint_sigma=reference.joint_sigma,
        statics=reference.statics,
        nominal=nominal,
    )
    return master(believed, log, observations, stated=stated)


def _start(reference: CalibratedRobot, nominal: RobotModel) -> RobotModel:
    """The nominal robot with what it has in common with the reference: elasticities, loads, base and tool.

    Raises
    ------
    InvalidInput : a robot of another type.
    """
    if [(f.name, f.axis, f.xyz, f.rpy) for f in nominal.frames] != [
        (f.name, f.axis, f.xyz, f.rpy) for f in reference.model.frames
    ]:
        raise InvalidInput(
            f"robot '{nominal.name}' is of another type than the reference '{reference.model.name}': frames differ"
        )
    known = reference.model.parameters
    shared = {n: v for n, v in known.items() if ".elastic_" in n or n.startswith(("payload.", "gravity."))}
    return replace(
        nominal.with_parameters({**nominal.parameters, **shared}),
        payloads=reference.model.payloads,
        world_T_base=reference.model.world_T_base,
        flange_T_tool=reference.model.flange_T_tool,
    )


def _geometry(nominal: RobotModel) -> tuple[list[str], list[str]]:
    """Names of the joints' zeros and of all other geometric parameters."""
    zeros = [f.zero_name for f in nominal.joints]
    others = [f"{f.name}.{k}" for f in nominal.frames for k in GEOMETRIC_KINDS if f"{f.name}.{k}" not in zeros]
    return zeros, others


def type_scatter(deviations: Mapping[str, float], names: list[str]) -> dict[str, float]:
    """Standard deviation of each geometric parameter: root mean square of those of its kind that a robot shows."""
    scatter = {}
    for kinds, least in ((("x", "y", "z"), LEAST_LENGTH), (("roll", "pitch", "yaw"), LEAST_ANGLE)):
        mine = [name for name in names if name.rpartition(".")[2] in kinds]
        seen = [deviations[name] for name in mine if name in deviations]
        size = float(np.sqrt(np.mean(np.square(seen)))) if seen else BELOW_LIMIT
        scatter.update({name: min(max(size, least), BELOW_LIMIT) for name in mine})
    return scatter


def transfer(new: CalibratedRobot, reference: CalibratedRobot, taught: JointLog) -> Transfer:
    """Joint values that bring the new robot's tool where the reference's tool was at the taught angles."""
    wanted, of_reference = reference.predict(reference.inputs(taught))
    inputs = new.inputs(taught)
    command = compensate(new.kernel, wanted, payload=taught.payload, covariates=dict(inputs.covariates), near=taught.q)
    there = inputs.with_q(np.where(np.isfinite(command.q), command.q, taught.q))
    T, of_new = new.predict(there)
    turned = transport_covariance(np.swapaxes(T[:, :3, :3], 1, 2) @ wanted[:, :3, :3], of_reference[:, :3, :3])
    sigma = np.sqrt(np.trace(of_new[:, :3, :3] + turned, axis1=1, axis2=2))
    before = np.linalg.norm(difference(wanted, new.kernel.frames(new.kernel.theta0, inputs))[:, :3], axis=1)
    return Transfer(command, sigma, before)

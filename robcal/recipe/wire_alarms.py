"""Lengths that links do not have, where a robot was identified from lengths of wires alone.

Sag, stretch or a wrong scale of a wire fit into the robot with small residuals and make it worse. How far a link is off
says little by itself: it has to be more than its own uncertainty and what links may deviate by explain, or a fault of
the wire has to explain it better than the links do.
"""

from collections.abc import Mapping

import numpy as np
from scipy import stats

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.identification import IdentifyOptions
from robcal.calibration.instruments import IdentifiedInstruments
from robcal.calibration.instruments.linearised import LinearInstruments, linearised
from robcal.calibration.joint_log import JointLog
from robcal.calibration.wire import LIMITS
from robcal.diagnosis.core.recording import Recording, observation_data
from robcal.diagnosis.core.result import Finding
from robcal.estimation.covariance import cofactor
from robcal.estimation.minimum_norm import solve
from robcal.physics.cause import DEVIATION, numeric_sigma
from robcal.physics.measuring import WIRE_SCALE, measuring_causes
from robcal.robot.kernel_cache import kernel_of
from robcal.robot.model import RobotModel

USUAL_LENGTH = 2e-4
"""m; deviation of a link that is usual. Less than that is no reason for an alarm."""
BELIEVED_LENGTH = 6e-4
"""m; standard deviation of the lengths of links where the campaign states none (`model.priors`)."""
SURE = 3.5
"""Standard deviations from which something is told: in a few of a thousand faultless campaigns."""
CERTAIN = 4.0
"""Standard deviations from which a wrong scale is not only an alarm but put right."""
WORDS: Mapping[str, str] = {
    "radius": "runs over a pulley",
    "sag": "sags",
    "stretch": "stretches",
    "scale": "has a wrong scale",
    "offset": "has a wrong zero",
}


def wire_alarms(
    model: RobotModel, found: IdentifiedInstruments, log: JointLog, options: IdentifyOptions | None = None
) -> list[str]:
    """A sentence where links are off in a way that wires explain, or that nothing does; empty where all is usual.

    Parameters
    ----------
    model : the robot that was identified from.
    options : as for the identification; its priors are what is believed of single parameters.
    """
    identified = [p for p in found.placed.values() if p.robot is not None and not p.instrument.loop]
    robot = identified[0].robot if identified else None
    if robot is None or any(p.instrument.dimension > 1 for p in identified):
        return []
    options = options or IdentifyOptions()
    links = _links(robot)
    # without a stated prior a link may be off by anything: robots of old drawings are
    off = {n: robot.values[n] - model.parameters.get(n, 0.0) for n in links}
    stated = {n: options.priors[n] for n in links if n in options.priors}
    far = [n for n in stated if abs(off[n]) - USUAL_LENGTH > SURE * np.hypot(_sigma(robot, n), stated[n])]
    named = [f"{n} {1e3 * off[n]:+.2f} +- {1e3 * _sigma(robot, n):.2g} mm" for n in far]
    reason = f"links are off by more than links may be ({', '.join(named)}), which a fault of the wire does"
    best = 0.0
    for placed in identified:
        for kind in LIMITS:
            if kind in placed.instrument.wire:
                continue
            name = f"{placed.instrument.name}.wire.{kind}"
            linear = linearised(model, found, log, options, {placed.instrument.name: (kind,)})
            value, sigma, moved = explained(linear, name, robot, options)
            strength = abs(value) / (sigma * max(robot.sigma0, 1.0))
            if strength > max(SURE, best) and moved:
                best = strength
                reason = f"a wire that {WORDS[kind]} explains it better than links that are off: " + ", ".join(
                    f"{n} {1e3 * off[n]:+.2f} mm would be {1e3 * (off[n] + v):+.2f} mm" for n, v in moved.items()
                )
    if not far and best == 0.0:
        return []
    return [f"identified from wires alone: {reason}; verify in 6D before driving with this robot"]


def scale_by_lengths(
    model: RobotModel,
    found: IdentifiedInstruments,
    name: str,
    recording: Recording,
    log: JointLog,
    options: IdentifyOptions,
) -> Finding | None:
    """A wrong scale of a wire, told by what is believed of the lengths of links; None where it is not certain.

    Parameters
    ----------
    model : the robot that was identified from. name : of the instrument.
    recording : its measurements as the diagnosis takes them.
    """
    robot = found.placed[name].robot
    if robot is None:
        return None
    linear = linearised(model, found, log, options, {name: ("scale",)})
    value, sigma, _ = explained(linear, f"{name}.wire.scale", robot, options)
    sigma *= max(robot.sigma0, 1.0)
    if abs(value) < CERTAIN * sigma:
        return None
    kernel = kernel_of(robot.model, options.statics)
    inputs = recording.inputs(kernel)
    frames, variables = kernel.frames(kernel.theta0, inputs), kernel.variables(kernel.theta0, inputs)
    causes = measuring_causes(observation_data(recording, frames, variables), (), "")
    cause = next(c for c in causes if c.kind is WIRE_SCALE)
    values, covariance = np.array([value]), np.array([[sigma**2]])
    reported, spread = numeric_sigma(cause.report, values, {}, covariance)
    strength = abs(value) / sigma
    return Finding(
        cause,
        {},
        values,
        covariance,
        reported,
        sigma=spread,
        p_value=2.0 * float(stats.norm.sf(strength)),
        log_evidence=0.5 * strength**2 - float(np.log(max(cause.priors[0] / sigma, 1.0))),
        heldout=(float("nan"), float("nan")),
        statement=cause.describe(reported),
    )


def _links(robot: CalibratedRobot) -> list[str]:
    frames = {f.name for f in robot.model.frames}
    parts = [(n, n.rpartition(".")) for n in robot.names]
    return [n for n, (frame, _, kind) in parts if frame in frames and kind in ("x", "y", "z")]


def _sigma(robot: CalibratedRobot, name: str) -> float:
    return float(robot.sigma[robot.names.index(name)])


def explained(
    linear: LinearInstruments, name: str, robot: CalibratedRobot, options: IdentifyOptions
) -> tuple[float, float, dict[str, float]]:
    """Change and standard deviation (SI) of a parameter of a wire beside links as they are believed, and the changes
    (m) of those lengths that it takes further than what is usual."""
    rows = [linear.jacobian.reshape(-1, len(linear.names)), linear.prior]
    left = [linear.residual.ravel(), linear.prior_residual]
    for k, (n, value) in enumerate(zip(linear.names, linear.values, strict=True)):
        size = _believed(n, robot, options)
        if size:
            rows.append(np.eye(1, len(linear.names), k) / size)
            left.append(np.array([-value / size]))
    J, r = np.concatenate(rows), np.concatenate(left)
    at = linear.names.index(name)
    others = np.delete(np.arange(J.shape[1]), at)
    with_it, without = solve(J, r), np.insert(solve(J[:, others], r), at, 0.0)
    sigma = float(np.sqrt(cofactor(J)[at, at]))
    change = dict(zip(linear.names, with_it - without, strict=True))
    moved = {n: float(change[n]) for n in _links(robot) if abs(change[n]) > USUAL_LENGTH}
    return float(with_it[at]), sigma, moved


def _believed(name: str, robot: CalibratedRobot, options: IdentifyOptions) -> float:
    """Standard deviation (m, rad) that geometry is believed to have; 0 where nothing is, or a prior counts already."""
    frame, _, kind = name.rpartition(".")
    if name in options.priors or frame not in {f.name for f in robot.model.frames} or kind.startswith("elastic_"):
        return 0.0
    return BELIEVED_LENGTH if kind in ("x", "y", "z") else DEVIATION

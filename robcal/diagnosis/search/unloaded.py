"""Elasticities of joints that carry no load as the model stands: they matter once a cause brings a load."""

from collections.abc import Iterable

import numpy as np

from robcal.diagnosis.core.recording import Recording
from robcal.robot.kernel_cache import kernel_of
from robcal.robot.model import RobotModel

NO_LOAD = 0.02
"""A joint whose largest moment is below this share of the robot's largest counts as unloaded."""


def unloaded_elasticities(model: RobotModel, recording: Recording, tied: Iterable[str]) -> dict[str, float]:
    """Values to assume for elasticities of unloaded joints: that of the nearest joint whose own is known.

    A vertical axis of a levelled robot has no load torque, so nothing is known of its elasticity and nothing depends
    on it; but a base off the plumb line acts through it, which a search from the value zero could not see.
    """
    joints = [joint for joint in model.joints if not joint.prismatic]
    own = {joint.elastic_name: joint for joint in joints}
    known = {k: model.parameters.get(name, 0.0) for k, name in enumerate(own)}
    candidates = {k: name for k, name in enumerate(own) if name in set(tied) and not known[k]}
    if not candidates or not any(known.values()):
        return {}
    kernel = kernel_of(model, "converged")
    variables = kernel.variables(kernel.theta0, recording.inputs(kernel))
    moments = [variables[f"torque{k}"] for k, joint in enumerate(model.joints, 1) if not joint.prismatic]
    largest = np.array([float(np.max(np.abs(moment))) for moment in moments])
    values: dict[str, float] = {}
    for k, name in candidates.items():
        if largest[k] > NO_LOAD * largest.max():
            continue
        nearest = min((other for other in known if known[other]), key=lambda other: abs(other - k))
        values[name] = known[nearest]
    return values

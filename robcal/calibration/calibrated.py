"""The calibrated robot as the stages hand it on: model, covariance, and what holds where a table does not say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from pipeline.poses_table import Poses
from pipeline.runs import Run
from robcal.errors import InvalidInput
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import GEOMETRIC_KINDS, RobotModel
from robcal.transforms import Array, frame_from_xyzrpy

Statics = Literal["one_step", "converged"]


@dataclass(frozen=True)
class Calibrated:
    """A calibrated robot.

    Attributes
    ----------
    model : robot with parameters and terms; nominal : the nominal robot in the best cell (base and tool fitted).
    names : free parameters; covariance : theirs (p, p), in metres and radians.
    q, tools : joint angles (n, N) and modelled tool frames (n, 4, 4) of the recorded poses.
    defaults : covariates at the first recorded pose, for poses to predict that do not state them.
    diagnosed : whether the diagnosis extended the model.
    joint_sigma : scatter of the joints (rad, m) that no parameter explains: repeatability and structure that is left.
    """

    model: RobotModel
    nominal: RobotModel
    statics: Statics
    names: tuple[str, ...]
    covariance: Array = field(repr=False)
    q: Array = field(repr=False)
    tools: Array = field(repr=False)
    defaults: Mapping[str, float] = field(default_factory=dict)
    diagnosed: bool = False
    joint_sigma: float = 0.0


def load_calibrated(run: Run) -> Calibrated:
    """The robot with all that was found out about it: after the diagnosis where there was one.

    Raises
    ------
    InvalidInput : the run has no calibrated robot.
    """
    for stage in ("diagnose", "identify"):
        name = f"calibrated_{stage}"
        if run.record(stage) is not None and run.has(name):
            found: Calibrated = run.load(name)
            return found
    raise InvalidInput(f"{run.folder}: holds no calibrated robot: the campaign needs a robot, poses and measurements")


def with_folded_cell(model: RobotModel) -> RobotModel:
    """The model with its deviations of base and tool folded into the references: readers of the robot file need not
    know them. Weakness: terms that act on base or tool follow the deviations instead of adding to them, a difference
    of second order.
    """
    references = {"base": model.world_T_base, "tool": model.flange_T_tool}
    folded = {}
    for end, reference in references.items():
        six = [model.parameters.get(f"{end}.{kind}", 0.0) for kind in GEOMETRIC_KINDS]
        folded[end] = (np.eye(4) if reference is None else reference) @ frame_from_xyzrpy(six)
    ends = {f"{end}.{kind}" for end in references for kind in GEOMETRIC_KINDS}
    parameters = {name: value for name, value in model.parameters.items() if name not in ends}
    return replace(model, parameters=parameters, world_T_base=folded["base"], flange_T_tool=folded["tool"])


def recorded_inputs(kernel: Kernel, poses: Poses) -> PoseInputs:
    """Inputs of the kernel at the recorded poses; ``index`` is the row in the table of poses."""
    covariates = dict(poses.covariates)
    covariates.update({f"approach{k + 1}": poses.approach[:, k] for k in range(poses.q.shape[1])})
    covariates["index"] = np.arange(len(poses), dtype=float)
    return kernel.poses(poses.q, poses.payload, covariates)


def defaults_of(poses: Poses) -> dict[str, float]:
    """What holds for poses to predict: time and temperatures as at the first pose, the state after the last one."""
    values = {name: float(column[0]) for name, column in poses.covariates.items()}
    return {**values, "index": float(len(poses))}


def inputs_to_predict(calibrated: Calibrated, kernel: Kernel, poses: Poses) -> PoseInputs:
    """Inputs of the kernel at poses to predict, with the defaults where the table does not say."""
    n = len(poses)
    covariates = {name: np.full(n, value) for name, value in calibrated.defaults.items()}
    covariates.update(poses.covariates)
    covariates.update({f"approach{k + 1}": poses.approach[:, k] for k in range(poses.q.shape[1])})
    return kernel.poses(poses.q, poses.payload, covariates)


def predicted(calibrated: Calibrated, poses: Poses, *, nominal: bool = False) -> tuple[Array, Array | None]:
    """Tool frames (n, 4, 4) in the world and their covariance (n, 6, 6); None for the nominal robot.

    The covariance says how far the tool may be from where it is told: uncertainty of the parameters, and what moves
    the joints without being in the model. Weakness: all that is left counts as scatter of the joints, alike and
    independent from pose to pose.
    """
    kernel = Kernel(calibrated.nominal if nominal else calibrated.model, calibrated.statics)
    inputs = inputs_to_predict(calibrated, kernel, poses)
    if nominal:
        return kernel.frames(kernel.theta0, inputs), None
    columns = np.array([kernel.index[name] for name in calibrated.names], dtype=np.intp)
    T, J = kernel.frames_and_jacobian(kernel.theta0, inputs, columns)
    covariance = J @ calibrated.covariance @ np.swapaxes(J, 1, 2)
    if calibrated.joint_sigma > 0.0:
        moved = calibrated.joint_sigma * kernel.joint_jacobian(kernel.theta0, inputs)
        covariance = covariance + moved @ np.swapaxes(moved, 1, 2)
    return T, covariance

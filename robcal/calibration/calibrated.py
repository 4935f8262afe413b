"""The calibrated robot: a model, how sure its parameters are, and the one function that predicts with it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from robcal.calibration.joint_log import JointLog
from robcal.errors import InvalidInput
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.kernel_cache import kernel_of
from robcal.robot.model import GEOMETRIC_KINDS, RobotModel
from robcal.transforms import Array, difference, frame_from_xyzrpy, transport_covariance

Statics = Literal["one_step", "converged"]


@dataclass(frozen=True, kw_only=True)
class CalibratedRobot:
    """A calibrated robot and how far it may be trusted.

    Attributes
    ----------
    model : robot with parameters and terms; references of base and tool set.
    names, covariance : fitted parameters (p,) and their covariance (p, p), m and rad; those of base and tool are right
        perturbations of the references.
    covariance_scale : factor by which the variances of the measurements are larger than stated.
    joint_sigma : scatter of the joints, rad or m, one number or one a joint, that no parameter explains.
    statics : 'one_step' or 'converged'.
    nominal : the nominal robot in the best cell (base and tool fitted).
    q, tools : joint angles (n, N) and modelled tool frames (n, 4, 4) of the recorded poses.
    defaults : covariates at the first recorded pose, for poses to predict that do not state them.
    """

    model: RobotModel
    names: tuple[str, ...] = ()
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    covariance_scale: float = 1.0
    joint_sigma: float | Sequence[float] = 0.0
    statics: Statics = "one_step"
    nominal: RobotModel | None = None
    q: Array | None = field(default=None, repr=False)
    tools: Array | None = field(default=None, repr=False)
    defaults: Mapping[str, float] = field(default_factory=dict)

    @property
    def kernel(self) -> Kernel:
        """The model ready to be evaluated."""
        return kernel_of(self.model, self.statics)

    @property
    def sigma(self) -> Array:
        """Standard deviations (p,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def theta(self) -> Array:
        """Values (p,) of the fitted parameters; base and tool are zero, their values live in the references."""
        return self.kernel.theta0[self.columns]

    @property
    def values(self) -> dict[str, float]:
        """Fitted values by name."""
        return dict(zip(self.names, self.theta.tolist(), strict=True))

    @property
    def columns(self) -> NDArray[np.intp]:
        """Indices of the fitted parameters in the kernel's theta."""
        index = self.kernel.index
        return np.array([index[name] for name in self.names], dtype=np.intp)

    def predict(self, poses: PoseInputs) -> tuple[Array, Array]:
        """Tool frames (n, 4, 4) in the world and the covariance (n, 6, 6) of their right twist.

        The covariance says how far the tool may be from where it is predicted: uncertainty of the parameters, and what
        moves the joints without being in the model. Weakness: all that is left counts as scatter of the joints, alike
        and independent from pose to pose.
        """
        kernel = self.kernel
        T, J = kernel.frames_and_jacobian(kernel.theta0, poses, self.columns)
        covariance = transport_covariance(J, self.covariance)
        if np.any(self.joint_sigma):
            moved = kernel.joint_jacobian(kernel.theta0, poses) * np.asarray(self.joint_sigma)
            covariance = covariance + moved @ np.swapaxes(moved, 1, 2)
        return T, covariance

    def inputs(self, log: JointLog) -> PoseInputs:
        """Inputs of the kernel at poses to predict, with the defaults where the table does not say."""
        given = {name: np.full(len(log), value) for name, value in self.defaults.items()}
        return self.kernel.poses(log.q, log.payload, {**given, **log.stated()})

    def uncalibrated(self) -> "CalibratedRobot":
        """The nominal robot in the best cell.

        Raises
        ------
        InvalidInput : it is not known.
        """
        if self.nominal is None:
            raise InvalidInput(f"robot '{self.model.name}': no nominal robot is known beside it")
        return CalibratedRobot(model=self.nominal, statics=self.statics, defaults=self.defaults)

    def nearest_recorded(self, wanted: Array) -> Array | None:
        """Joint angles (n, N) of the recorded poses whose tools are nearest to wanted frames (n, 4, 4) in the world."""
        if self.q is None or self.tools is None:
            return None
        near = np.empty((len(wanted), self.q.shape[1]))
        for i, T in enumerate(wanted):
            twist = difference(self.tools, T)
            # half a metre of lever makes a turn comparable to a way
            way = np.sum(twist[:, :3] ** 2, axis=1) + 0.25 * np.sum(twist[:, 3:] ** 2, axis=1)
            near[i] = self.q[np.argmin(way)]
        return near

    def with_recording(self, log: JointLog, nominal: RobotModel) -> Self:
        """With what predictions need to know of the poses that were recorded, and the nominal robot to compare with.

        Time and temperatures of poses to predict are those of the first pose, the state is that after the last one.
        """
        defaults = {name: float(column[0]) for name, column in log.covariates.items()}
        T = self.kernel.frames(self.kernel.theta0, log.inputs(self.kernel))
        return replace(self, nominal=nominal, q=log.q, tools=T, defaults={**defaults, "index": float(len(log))})


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

"""A simulated identification: truth, poses, noise. Not a test module."""

from dataclasses import dataclass

import numpy as np

from robcal import transforms as tf
from robcal.calibration.observations import FrameObservations
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import GEOMETRIC_KINDS, RobotModel
from tests.robot.chains import kr_like

LIMITS = np.deg2rad([[-150, 150], [-60, 70], [-70, 70], [-170, 170], [-110, 110], [-170, 170]])


@dataclass(frozen=True)
class Scenario:
    """Nominal model, its kernel, the true parameters and references, and poses for identification and verification."""

    model: RobotModel
    kernel: Kernel
    truth: Kernel
    theta: np.ndarray
    poses: PoseInputs
    kept_out: PoseInputs
    rng: np.random.Generator

    def frames(self, poses: PoseInputs, sigma: float = 5e-5, sigma_angle: float = 1e-4) -> FrameObservations:
        """Measured frames."""
        T = self.truth.frames(self.theta, poses)
        noise = self.rng.normal(size=(len(poses), 6)) * np.repeat([sigma, sigma_angle], 3)
        return FrameObservations.isotropic(tf.retract(T, noise), sigma, sigma_angle)


def scenario(
    seed: int,
    compliant: bool = True,
    n: int = 80,
    n_out: int = 200,
    scale: float = 1.0,
    model: RobotModel | None = None,
) -> Scenario:
    """A robot with random frame errors (0.4 mm, 0.5-0.8 mrad) and compliances (0.3-3.3 urad/(N m))."""
    rng = np.random.default_rng(seed)
    model = kr_like() if model is None else model
    kernel = Kernel(model)
    theta = kernel.theta0.copy()
    for f in model.frames:
        for kind in GEOMETRIC_KINDS:
            size = 4e-4 if kind in "xyz" else rng.uniform(5e-4, 8e-4)
            theta[kernel.index[f"{f.name}.{kind}"]] = scale * size * rng.normal()
    if compliant:
        for f in model.joints:
            if not f.prismatic:
                theta[kernel.index[f"{f.name}.elastic_{f.joint_kind}"]] = rng.uniform(0.3e-6, 3.3e-6)
    turn = rng.uniform(-np.pi, np.pi)
    W = tf.frame_from_xyzrpy([*rng.normal(0, 2, 3), 0.022 * np.cos(turn), 0.022 * np.sin(turn), turn])
    F = tf.frame_from_xyzrpy([*rng.normal(0, 0.15, 3), *rng.uniform(-2, 2, 3)])

    def q(count: int) -> np.ndarray:
        if model.n_joints == 6:
            return rng.uniform(LIMITS[:, 0], LIMITS[:, 1], (count, 6))
        return rng.uniform(-1.2, 1.2, (count, model.n_joints))

    loads = "dumbbell" if "dumbbell" in model.payloads else None
    inside, outside = kernel.poses(q(n), loads), kernel.poses(q(n_out), loads)
    return Scenario(model, kernel, kernel.with_references(W, F), theta, inside, outside, rng)


def tool_residual(T: np.ndarray, truth: np.ndarray) -> float:
    """Mean distance of tool origins, m."""
    return float(np.linalg.norm((T - truth)[:, :3, 3], axis=1).mean())

"""Simulated robots for the benchmarks: a 125 kg class arm with frame errors and compliances."""

from dataclasses import dataclass

import numpy as np

from robcal import transforms as tf
from robcal.calibration.observations import FrameObservations
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import GEOMETRIC_KINDS, Frame, Payload, RobotModel

LIMITS = np.deg2rad([[-150, 150], [-60, 70], [-70, 70], [-170, 170], [-110, 110], [-170, 170]])
BASE_TILT = 0.022


def kr125_like() -> RobotModel:
    """Proportions of a six-axis arm of the 125 kg class (public data sheets, rounded), zero position of the thesis."""
    frames = (
        Frame("axis1", "z", xyz=(0, 0, 0.865), mass=310, cog=(0.06, -0.02, -0.15)),
        Frame("axis2", "y", xyz=(0.41, 0, 0), mass=190, cog=(0.45, 0.06, 0)),
        Frame("axis3", "y", xyz=(1.0, 0, 0), mass=200, cog=(0.15, 0.05, 0.02)),
        Frame("axis4", "x", xyz=(0.5, 0, -0.045), mass=60, cog=(0.2, 0.01, 0)),
        Frame("axis5", "y", xyz=(0.5, 0, 0), mass=35, cog=(0.05, 0.02, 0)),
        Frame("axis6", "x", xyz=(0.1, 0, 0), mass=12, cog=(0.05, 0, 0)),
        Frame("flange", None, xyz=(0.11, 0, 0), rpy=(0, np.pi / 2, 0)),
    )
    payloads = {f"{m} kg": Payload(float(m), (0.01, 0.02, 0.21)) for m in (172, 124, 84, 33)}
    return RobotModel("kr125-like", frames, payloads=payloads)


@dataclass(frozen=True)
class Truth:
    """A true robot: kernel with references, and parameters."""

    kernel: Kernel
    theta: np.ndarray

    def frames(self, poses: PoseInputs) -> np.ndarray:
        """True tool frames."""
        return self.kernel.frames(self.theta, poses)

    @property
    def form(self) -> list[str]:
        """Names of the parameters that are not zero: what an oracle would identify."""
        return [n for n, v in zip(self.kernel.names, self.theta, strict=True) if v != 0.0]


def true_robot(
    kernel: Kernel, rng: np.random.Generator, compliant: bool, scale: float = 1.0, cross: float = 0.0
) -> Truth:
    """Six errors a frame (0.4 mm; 0.5-0.8 mrad), joint compliances 0.3-3.3 urad/(N m), base tilted by 22 mrad.

    ``cross`` is the size of compliances across the joint axes (rad/(N m)).
    """
    theta = kernel.theta0.copy()
    for f in kernel.model.frames:
        for kind in GEOMETRIC_KINDS:
            size = 4e-4 if kind in "xyz" else rng.uniform(5e-4, 8e-4)
            theta[kernel.index[f"{f.name}.{kind}"]] = scale * size * rng.normal()
        if f.axis is not None and compliant:
            for kind in ("roll", "pitch", "yaw"):
                own = kind == f.joint_kind
                value = rng.uniform(0.3e-6, 3.3e-6) if own else cross * rng.uniform()
                theta[kernel.index[f"{f.name}.elastic_{kind}"]] = value
    turn = rng.uniform(-np.pi, np.pi)
    tilt = [BASE_TILT * np.cos(turn), BASE_TILT * np.sin(turn)]
    W = tf.frame_from_xyzrpy([*rng.normal(0, 2, 3), *tilt, rng.uniform(-np.pi, np.pi)])
    F = tf.frame_from_xyzrpy([*rng.normal(0, 0.15, 3), *rng.uniform(-1, 1, 3)])
    return Truth(kernel.with_references(W, F), theta)


def random_poses(kernel: Kernel, rng: np.random.Generator, n: int, payload: str | None = "172 kg") -> PoseInputs:
    """Poses equally distributed over the joint ranges."""
    return kernel.poses(rng.uniform(LIMITS[:, 0], LIMITS[:, 1], (n, 6)), payload)


def measured(
    truth: Truth, poses: PoseInputs, rng: np.random.Generator, sigma: float = 5e-5, sigma_angle: float = 1e-4
) -> FrameObservations:
    """Measured frames with noise in all six directions."""
    noise = rng.normal(size=(len(poses), 6)) * np.repeat([sigma, sigma_angle], 3)
    return FrameObservations.isotropic(tf.retract(truth.frames(poses), noise), sigma, sigma_angle)


def table(title: str, head: list[str], rows: list[list[object]]) -> None:
    """Print a table with right-aligned columns."""
    cells = [
        head,
        *[[v if isinstance(v, str) else f"{v:.4g}" if isinstance(v, float) else str(v) for v in r] for r in rows],
    ]
    widths = [max(len(r[k]) for r in cells) for k in range(len(head))]
    print(f"\n{title}")
    for k, row in enumerate(cells):
        print(
            "  "
            + "  ".join(c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True)))
        )
        if k == 0:
            print("  " + "  ".join("-" * w for w in widths))

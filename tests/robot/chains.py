"""Random and typical chains for the tests of robot and calibration."""

import numpy as np

from robcal.robot.model import Frame, Payload, RobotModel, Term


def kr_like(**changes: object) -> RobotModel:
    """A 125 kg class palletiser-like arm with spherical wrist; public proportions, rounded."""
    arguments: dict = {
        "name": "kr-like",
        "frames": (
            Frame("axis1", "z", xyz=(0, 0, 0.75), mass=310, cog=(0.06, -0.02, 0.04)),
            Frame("axis2", "y", xyz=(0.35, 0, 0), mass=190, cog=(0.48, 0.06, 0)),
            Frame("axis3", "y", xyz=(1.05, 0, 0), mass=200, cog=(0.2, 0.06, 0)),
            Frame("axis4", "x", xyz=(0.6, 0, -0.05), mass=60, cog=(0.2, 0.06, 0)),
            Frame("axis5", "y", xyz=(0.4, 0, 0), mass=30, cog=(0.05, 0.06, 0)),
            Frame("axis6", "x", xyz=(0.1, 0, 0), mass=10, cog=(0.05, 0.0, 0)),
            Frame("flange", None, xyz=(0.115, 0, 0), rpy=(0, np.pi / 2, 0)),
        ),
        "payloads": {"dumbbell": Payload(172.0, (0.01, 0.02, 0.21))},
    }
    return RobotModel(**{**arguments, **changes})


def random_chain(rng: np.random.Generator, n_frames: int = 6, **changes: object) -> RobotModel:
    """Any order of rotary, sliding and fixed frames with random offsets, angles and masses."""
    frames = []
    for i in range(n_frames):
        axis = [None, "x", "y", "z", "x", "y", "z"][int(rng.integers(7))] if i else "z"
        frames.append(
            Frame(
                f"f{i}",
                axis,
                prismatic=bool(axis and rng.random() < 0.25),
                sign=int(rng.choice([-1, 1])),
                xyz=tuple(rng.normal(0, 0.5, 3)),
                rpy=tuple(rng.uniform(-1, 1, 3)),
                mass=float(rng.uniform(0, 100)),
                cog=tuple(rng.normal(0, 0.2, 3)),
            )
        )
    arguments: dict = {"name": "random", "frames": tuple(frames), "payloads": {"load": Payload(50.0, (0.1, 0.0, 0.2))}}
    return RobotModel(**{**arguments, **changes})


def random_theta(rng: np.random.Generator, names: tuple[str, ...], scale: float = 1.0) -> np.ndarray:
    """Deviations of the usual size: 1 mm, 1 mrad, 1 urad/(N m), 1 kg."""
    size = {"elastic": 1e-6, "mass": 1.0}
    return scale * np.array([rng.normal() * next((s for k, s in size.items() if k in n), 1e-3) for n in names])


TERMS = (
    Term("f0.wave", "f0", "q", "a*sin(q1 + b) + c*tanh(torque1/300)", {"a": 1e-3, "b": 0.3, "c": 1e-3}),
    Term("base.tilt", "base", "pitch", "k*base_my", {"k": 1e-7}),
    Term("tool.drift", "tool", "z", "rate*time_s*(1 + approach1)", {"rate": 1e-7}),
)

"""A calibrated robot as Universal Robots' own calibration (package ur_calibration): origins of six joints about z.

Weakness: behind the sixth joint stands the controller's flange, so that a flange that is out of square with axis 6 has
no place in the format; what is left over is told, and belongs into the tool.
"""

from collections.abc import Sequence

import numpy as np

from robcal.errors import InvalidInput
from robcal.robot.export.urdf import calibrated_origins
from robcal.robot.model import RobotModel
from robcal.robot.urdf_chain import UrdfStep, model_from_steps
from robcal.transforms import Array, exp_so3, frame, frame_from_xyzrpy, invert, xyzrpy_from_frame

KINDS = ("x", "y", "z", "roll", "pitch", "yaw")


def ur_kinematics(model: RobotModel, steps: Sequence[UrdfStep]) -> tuple[dict[str, dict[str, float]], Array]:
    """The six origins by link (m, rad), and the frame (4, 4) left over between the format's flange and the robot's.

    Parameters
    ----------
    steps : the joints of the nominal calibration that the robot was read from.

    Raises
    ------
    InvalidInput : the robot does not come from these joints.
    """
    nominal = model_from_steps(model.name, steps)
    if [f.name for f in nominal.frames] != [f.name for f in model.frames]:
        raise InvalidInput(
            f"robot '{model.name}' was not read from a kinematics.yaml of Universal Robots: its frames are "
            f"{', '.join(f.name for f in model.frames)}"
        )
    entries = {}
    turned = np.eye(4)  # from the format's link frame before, whose z is the axis, to the robot's own
    for step, (origin, axis) in zip(steps, calibrated_origins(model, nominal, steps), strict=True):
        own = frame(_turn_z_to(axis), np.zeros(3))
        values = xyzrpy_from_frame(invert(turned) @ origin @ own)
        entries[step.child] = dict(zip(KINDS, (float(v) for v in values), strict=True))
        turned = own
    return entries, invert(_zero_flange(entries)) @ _flange(model)


def _zero_flange(entries: dict[str, dict[str, float]]) -> Array:
    T = np.eye(4)
    for entry in entries.values():
        T = T @ frame_from_xyzrpy([entry[k] for k in KINDS])
    return T


def _flange(model: RobotModel) -> Array:
    """base_T_flange at zero with the deviations."""
    T = np.eye(4)
    for f in model.frames:
        deviation = [model.parameters.get(f"{f.name}.{k}", 0.0) for k in KINDS]
        T = T @ frame_from_xyzrpy(np.add([*f.xyz, *f.rpy], deviation))
    return T


def _turn_z_to(axis: Array) -> Array:
    """The shortest rotation that takes z to a direction near it."""
    unit = np.asarray(axis) / np.linalg.norm(axis)
    across = np.cross([0.0, 0.0, 1.0], unit)
    sine = float(np.linalg.norm(across))
    return exp_so3(across / sine * np.arctan2(sine, unit[2])) if sine > 1e-15 else np.eye(3)

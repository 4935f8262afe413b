"""FIGAROH (package ``figaroh``, on pinocchio) as a peer: the same chain as URDF, the same measured frames as CSV.

Used through its own classes and defaults (choice of parameters, closed-form start of base and tool,
Levenberg-Marquardt); only the weights of lengths and angles are told, as its cost function asks for. Its joint
elasticities take the torque that pinocchio computes; the payload is made part of the last link.
"""

import contextlib
import io
import logging
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from robcal import transforms as tf
from robcal.robot.export.urdf import urdf_text
from robcal.robot.model import RobotModel

SIGMA, SIGMA_ANGLE = 5e-5, 1e-4
COMPONENTS = ("x", "y", "z", "phix", "phiy", "phiz")


def predicted_positions(
    model: RobotModel,
    payload: str,
    q: np.ndarray,
    T: np.ndarray,
    q_out: np.ndarray,
    elastic: bool,
    mended: bool = False,
) -> tuple[np.ndarray, float]:
    """Predicted tool positions (n, 3) at kept-out joint angles and processor seconds of set-up and fit.

    Naming an unknown base overwrites the first six parameters (the elasticities, or those of joints 1 and 2); with
    ``mended`` six places are kept free for it.

    Raises
    ------
    ImportError : FIGAROH is not installed.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from figaroh.calibration.base_calibration import BaseCalibration
        from figaroh.calibration.calibration_tools import calc_updated_fkm
        from figaroh.tools.robot import Robot

    class Arm(BaseCalibration):  # type: ignore[misc]
        def cost_function(self, var: np.ndarray) -> np.ndarray:
            estimated = calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
            raw = self._compute_logmap_residuals(self.PEE_measured, estimated)
            return np.asarray(self.apply_measurement_weighting(raw, 1.0 / SIGMA, 1.0 / SIGMA_ANGLE))

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        logging.disable(logging.WARNING)
        here = Path(folder)
        (here / "arm.urdf").write_text(urdf_text(_with_load(model, payload)), encoding="utf-8")
        robot = Robot(str(here / "arm.urdf"), str(here))
        joints = list(robot.model.names)[1:]
        six = np.concatenate([T[:, :3, 3], tf.rpy_from_rotation(T[:, :3, :3])], axis=1)
        head = ",".join([f"{c}1" for c in COMPONENTS] + joints)
        np.savetxt(here / "data.csv", np.concatenate([six, q], axis=1), delimiter=",", header=head, comments="")
        (here / "config.yaml").write_text(yaml.safe_dump(_config(robot, here / "data.csv", len(q), elastic)))
        start = time.process_time()
        fit = Arm(robot, str(here / "config.yaml"))
        fit.calib_config["known_baseframe"] = fit.calib_config["known_tipframe"] = False
        if mended:  # naming the base overwrites the first six names, whatever they are
            fit.calib_config["param_name"] = ["base"] * 6 + fit.calib_config["param_name"]
        fit.initialize()
        result, _ = fit.solve_optimisation(max_iterations=1, outlier_threshold=1.0)
        x = result.x
        seconds = time.process_time() - start
        settings: dict[str, Any] = {**fit.calib_config, "NbSample": len(q_out)}
        flat = calc_updated_fkm(fit.model, fit.data, x, np.asarray(q_out), settings)
        logging.disable(logging.NOTSET)
    return np.asarray(flat).reshape(6, len(q_out))[:3].T, seconds


def _with_load(model: RobotModel, payload: str) -> RobotModel:
    """The model with the payload as mass of its flange, and limits: joints without any get two numbers in pinocchio."""
    load, flange = model.payloads[payload], replace(model.frames[-1], mass=model.payloads[payload].mass)
    turning = [replace(f, limits=f.limits or (-3.2, 3.2)) if f.axis else f for f in model.frames[:-1]]
    return replace(model, frames=(*turning, replace(flange, cog=load.cog)), payloads={})


def _config(robot: Any, data: Path, samples: int, elastic: bool) -> dict[str, Any]:
    """Its unified configuration: everything free, all six components of one marker measured."""
    frames = [f.name for f in robot.model.frames]
    return {
        "robot": {"name": "arm"},
        "tasks": {
            "calibration": {
                "type": "kinematic_calibration",
                "enabled": True,
                "kinematics": {"base_frame": "universe", "tool_frame": frames[-1]},
                "measurements": {"markers": [{"measurable_dof": [True] * 6}]},
                "parameters": {"calibration_level": "full_params", "include_non_geometric": elastic},
                "data": {"source_file": str(data), "number_of_samples": samples},
            }
        },
    }

"""Concealed campaigns of the fixtures as recordings that the diagnosis takes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import robcal
from fixtures.campaigns import make_campaign
from robcal.calibration.variance_components import identify_recording
from robcal.diagnosis.core.recording import Recording
from robcal.recipe.recording import recording_for_diagnosis
from robcal.robot.kernel import Kernel
from robcal.robot.model import Payload


def concealed(folder: Path, **plan: Any) -> tuple[robcal.IdentifiedRobot, Recording, Recording, Any]:
    """Identified robot, recordings to identify from and to verify with, and the truth of a concealed campaign."""
    truth = make_campaign(folder, **plan)
    entry = yaml.safe_load((folder / "campaign.yaml").read_text(encoding="utf-8"))
    loads = {name: Payload(p["mass_kg"], tuple(v / 1000 for v in p["cog_mm"])) for name, p in entry["payloads"].items()}
    robot = replace(robcal.read_any_robot(folder / entry["robot"]), payloads=loads)
    files = {name: robcal.read_body(folder / use["targets"]) for name, use in entry.get("bodies", {}).items()}
    body = next((robcal.body_from_file(name, file) for name, file in files.items()), None)
    log = robcal.read_joint_log(folder / entry["poses"], robot)
    measured = robcal.read_recording(folder / entry["measurements"], log, body)
    rows = np.flatnonzero(~log.verify)
    options = robcal.IdentifyOptions(statics="converged", covariance="auto" if measured.stated else "estimated")
    kernel = Kernel(robot, options.statics)
    found, measured = identify_recording(robot, log.inputs(kernel), measured, rows, options, kernel)
    identify = recording_for_diagnosis(log, measured, rows, body)
    verify = recording_for_diagnosis(log, measured, np.flatnonzero(log.verify), body)
    assert identify is not None
    assert verify is not None
    return found, identify, verify, truth

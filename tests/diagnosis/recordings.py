"""Concealed campaigns of the fixtures as recordings that the diagnosis takes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fixtures.campaigns import make_campaign
from pipeline.bodies import body_for_robot
from pipeline.campaign import read_campaign
from pipeline.runs import Run
from pipeline.stages.identify import options_of, require_robot
from pipeline.stages.observations import build_recording
from robcal.calibration.identification import IdentifiedRobot
from robcal.calibration.variance_components import identify_recording
from robcal.diagnosis.core.recording import Recording
from robcal.recipe.recording import recording_for_diagnosis
from robcal.robot.kernel import Kernel


def concealed(folder: Path, **plan: Any) -> tuple[IdentifiedRobot, Recording, Recording, Any]:
    """Identified robot, recordings to identify from and to verify with, and the truth of a concealed campaign."""
    truth = make_campaign(folder / "campaign", **plan)
    campaign = read_campaign(folder / "campaign")
    robot, poses = require_robot(campaign)
    body = body_for_robot(campaign, Run(folder / "run"))
    measured = build_recording(campaign, Run(folder / "run"), body)
    rows = np.flatnonzero(~poses.verify)
    kernel = Kernel(robot, campaign.entry.model.statics)
    options = options_of(campaign, measured.stated)
    found, measured = identify_recording(robot, poses.inputs(kernel), measured, rows, options, kernel)
    identify = recording_for_diagnosis(poses, measured, rows, body)
    verify = recording_for_diagnosis(poses, measured, np.flatnonzero(poses.verify), body)
    assert identify is not None
    assert verify is not None
    return found, identify, verify, truth

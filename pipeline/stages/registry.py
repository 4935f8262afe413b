"""The stages in the order in which they run."""

from pipeline.stages import (
    adjust,
    detect,
    diagnose,
    frames,
    hand_eye,
    identify,
    measure,
    orient,
    report,
    survey,
    verify,
)
from pipeline.stages.base import Stage

STAGES: tuple[Stage, ...] = (
    detect.STAGE,
    survey.STAGE,
    orient.STAGE,
    measure.STAGE,
    frames.STAGE,
    identify.STAGE,
    diagnose.STAGE,
    adjust.STAGE,
    verify.STAGE,
    hand_eye.STAGE,
    report.STAGE,
)

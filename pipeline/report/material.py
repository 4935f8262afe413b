"""What a run holds for its report. A stage that did not run leaves None; nothing here computes."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from pipeline import artifacts
from pipeline.artifacts import Artifact
from pipeline.campaign import Campaign
from pipeline.campaign_reader import read_campaign
from pipeline.codec import StaleCache
from pipeline.detected_images import DetectionIndex
from pipeline.json_io import read_json
from pipeline.runs import Run, campaign_of, run_file
from pipeline.stages.registry import STAGES
from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.measurements import Rows
from robcal.calibration.verification import Verification
from robcal.errors import RobcalError
from robcal.photogrammetry.measure.frames import MeasuredFrames
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.photogrammetry.station.network import StationOrientation
from robcal.photogrammetry.survey.types import SurveyResult
from robcal.recipe.evidence import Evidence
from robcal.recipe.identification import Identification

T = TypeVar("T")


@dataclass(frozen=True)
class Material:
    """A run and, where it is still there, its campaign."""

    run: Run

    @cached_property
    def name(self) -> str:
        """Name of the campaign."""
        return str(read_json(run_file(self.run)).get("name", self.run.folder.name))

    @cached_property
    def campaign_folder(self) -> Path:
        """Folder of the campaign."""
        path = campaign_of(self.run)
        return path.parent if path.suffix else path

    @cached_property
    def campaign(self) -> Campaign | None:
        """The campaign, None if it was moved or changed so that it cannot be read."""
        try:
            return read_campaign(campaign_of(self.run))
        except RobcalError:
            return None  # the report tells what the run itself holds

    @cached_property
    def stages(self) -> tuple[str, ...]:
        """Stages that ran, in order."""
        campaign = self.campaign
        names = [s.name for s in STAGES if campaign is None or s.applies(campaign)]
        return tuple(name for name in names if name != "report" and self.run.record(name) is not None)

    @cached_property
    def result(self) -> dict[str, Any]:
        """The stages' parts of result.json together."""
        out: dict[str, Any] = {}
        for name in self.stages:
            record = self.run.record(name)
            out |= dict(record.result) if record else {}
        return out

    @cached_property
    def notes(self) -> tuple[tuple[str, str], ...]:
        """(stage, sentence) about everything left out or assumed."""
        out = [("campaign", n) for n in (*self.campaign.warnings, *self.campaign.notes)] if self.campaign else []
        for name in self.stages:
            record = self.run.record(name)
            out += [(name, note) for note in record.notes] if record else []
        return tuple(out)

    @cached_property
    def timing(self) -> dict[str, float]:
        """Seconds by stage."""
        return {name: record.seconds for name in self.stages if (record := self.run.record(name)) is not None}

    def find(self, artifact: Artifact[T]) -> T | None:
        """A stage's stored result, None if the stage did not run or its result is of another version."""
        try:
            return self.run.find(artifact) if artifact.stage in self.stages else None
        except StaleCache:
            return None

    @cached_property
    def diagnosis(self) -> dict[str, Any] | None:
        """Content of diagnosis.json."""
        if "diagnose" not in self.stages or not self.run.diagnosis.is_file():
            return None
        return read_json(self.run.diagnosis)

    @cached_property
    def detections(self) -> DetectionIndex | None:
        """Index of the images."""
        return self.find(artifacts.DETECTED)

    @cached_property
    def surveys(self) -> dict[str, SurveyResult]:
        """Surveyed bodies by name."""
        names = self.result.get("survey", {})
        found = {name: self.find(artifacts.survey(name)) for name in names}
        return {name: result for name, result in found.items() if result is not None}

    @cached_property
    def station(self) -> StationOrientation | None:
        """The oriented station."""
        return self.find(artifacts.ORIENTATION)

    @cached_property
    def points(self) -> MeasuredPoints | None:
        """Measured points."""
        return self.find(artifacts.POINTS)

    @cached_property
    def frames(self) -> MeasuredFrames | None:
        """Measured frames."""
        return self.find(artifacts.FRAMES)

    @cached_property
    def identification(self) -> Identification | None:
        """Result of the stage identify."""
        return self.find(artifacts.IDENTIFICATION)

    @cached_property
    def calibrated(self) -> CalibratedRobot | None:
        """The calibrated robot with what the diagnosis added."""
        adjusted = self.find(artifacts.ADJUSTED)
        found = self.find(artifacts.CALIBRATED) if adjusted is None else adjusted.robot
        return found if found is not None or self.identification is None else self.identification.robot

    @cached_property
    def verification(self) -> tuple[Verification, Rows] | None:
        """Verification and the rows of its poses."""
        return self.find(artifacts.VERIFICATION)

    @cached_property
    def evidence(self) -> Evidence | None:
        """Plots of the diagnosis, as numbers."""
        return self.find(artifacts.EVIDENCE)

    @cached_property
    def pose_names(self) -> tuple[str, ...]:
        """Names of the poses; numbers where the campaign is gone."""
        if self.campaign is not None and self.campaign.poses is not None:
            return self.campaign.poses.names
        return ()

    @cached_property
    def all_poses(self) -> tuple[str, ...]:
        """Names of all poses that rows refer to, also where the campaign is gone."""
        robot = self.calibrated
        count = len(robot.q) if robot is not None and robot.q is not None else 0
        return tuple(self.pose_name(row) for row in range(max(count, len(self.pose_names))))

    def pose_name(self, row: int) -> str:
        """Name of a pose."""
        return self.pose_names[row] if 0 <= row < len(self.pose_names) else f"row {row + 1}"


def is_platform(material: Material) -> bool:
    """Whether the robot is a Stewart platform, which has legs in place of joint angles."""
    return material.calibrated is not None and bool(material.calibrated.model.is_hexapod)

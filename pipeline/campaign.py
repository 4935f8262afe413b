"""A campaign: what was recorded and what is what, read and checked before any stage runs. Never written to."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.campaign_schema import CampaignEntry, InstrumentEntry, SurveyEntry
from robcal.calibration.instruments import CellFrame
from robcal.files.body_file import BodyFile
from robcal.files.camera_file import CameraFile
from robcal.files.measurement_tables import MarksTable, MeasuredTable
from robcal.files.poses_table import Poses
from robcal.files.yaml_io import YamlDocument
from robcal.photogrammetry.tiles.transformation import Reseau
from robcal.robot.model import RobotModel
from robcal.transforms import Array


@dataclass(frozen=True)
class ImageSource:
    """Where the marks of a camera or a survey come from: image files or a table of marks.

    Attributes
    ----------
    images : name -> file (the name is the file name; for a station camera the pose id); empty if marks are given.
    reseau : the grid of a camera that takes tiles; ``images`` are then lists of tiles. reseau_files : it was read from.
    start : camera file with start values, None if there is none.
    """

    images: Mapping[str, Path]
    marks: MarksTable | None
    start: CameraFile | None
    start_path: Path | None = None
    size: tuple[int, int] | None = None
    reseau: Reseau | None = field(default=None, repr=False)
    reseau_files: tuple[Path, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Image names in order."""
        return tuple(self.images) if self.marks is None else tuple(dict.fromkeys(self.marks.image))


@dataclass(frozen=True)
class BodySource:
    """A body of the campaign and its survey, if there is one."""

    file: BodyFile
    survey: ImageSource | None = None
    survey_entry: SurveyEntry | None = None


@dataclass(frozen=True)
class InstrumentSource:
    """An instrument of the campaign: its tables, None for the own station, and what is known of its world and tool."""

    tables: tuple[MeasuredTable, ...] | None
    entry: InstrumentEntry | None
    world: CellFrame
    tool: CellFrame


@dataclass(frozen=True)
class HandEyeSource:
    """The images of a hand-eye calibration; ``base_T_flange`` (n, 4, 4) where the campaign states it, m."""

    images: ImageSource
    base_T_flange: Array | None = None


@dataclass(frozen=True)
class Campaign:
    """Everything a run needs to know, in SI units.

    Attributes
    ----------
    instruments : by name; empty where one instrument measured of which nothing is known beforehand.
    notes : what was assumed; warnings : what does not fit together but does not stop the work.
    """

    path: Path
    entry: CampaignEntry
    document: YamlDocument = field(repr=False)
    robot: RobotModel | None
    poses: Poses | None
    bodies: Mapping[str, BodySource]
    cameras: Mapping[str, ImageSource]
    measurements: tuple[MeasuredTable, ...]
    instruments: Mapping[str, InstrumentSource] = field(default_factory=dict)
    hand_eye: HandEyeSource | None = None
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    files: tuple[Path, ...] = field(default=(), repr=False)

    @property
    def name(self) -> str:
        """Name of the campaign."""
        return self.entry.name

    @property
    def measures_robot(self) -> bool:
        """Whether a station or another instrument measured the robot."""
        return self.entry.station is not None or bool(self.measurements) or bool(self.instruments)

    @property
    def carried_body(self) -> str | None:
        """Name of the body that the robot carries (or that the sensor looks at), None if there is none."""
        if self.entry.station is not None:
            return self.entry.station.body
        if self.entry.body is not None:
            return self.entry.body
        return next(iter(self.bodies)) if len(self.bodies) == 1 else None

    def measured(self, kind: str) -> tuple[MeasuredTable, ...]:
        """Tables of one kind."""
        return tuple(table for table in self.measurements if table.kind == kind)


def all_sources(campaign: Campaign) -> list[ImageSource]:
    """The sources of images or marks of all surveys and cameras."""
    surveys = [body.survey for body in campaign.bodies.values() if body.survey is not None]
    own = [] if campaign.hand_eye is None else [campaign.hand_eye.images]
    return [*surveys, *campaign.cameras.values(), *own]

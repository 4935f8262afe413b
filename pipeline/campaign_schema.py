"""campaign.yaml (format robcal/campaign-1): the entries as a person writes them."""

import re
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from robcal.files.foreign_tables import Orientation, TableMap
from robcal.files.robot_file import PayloadEntry
from robcal.files.schemas import Entry, NotNegative, Positive, Text, Triple, Whole

FORMAT = "robcal/campaign-1"
RESERVED = {"CON", "PRN", "AUX", "NUL", *(f"{port}{k}" for port in ("COM", "LPT") for k in range(1, 10))}
"""Names of devices, which Windows takes for no file."""


def _folder_name(value: Any) -> Any:
    text = str(value)
    usable = text.strip() and text.isprintable() and not any(c in text for c in "/\\")
    if not usable or text in {".", ".."} or len(text) > 120:
        raise ValueError(f"must be a plain name without slashes (it names the run folder), found {text[:60]!r}")
    if text[-1] in ". " or text.split(".")[0].strip().upper() in RESERVED:
        raise ValueError(f"{text!r} cannot be a folder on Windows (a device's name, or a dot or blank at the end)")
    return text


def _instrument_name(value: Any) -> Any:
    text = str(value)
    if not re.fullmatch(r"[A-Za-z][\w-]{0,59}", text):
        raise ValueError(f"an instrument's name has letters, digits, _ and -, found {text[:60]!r}")
    return text


def _pair(value: Any) -> Any:
    if isinstance(value, list) and len(value) == 2 and value[0] == value[1]:
        raise ValueError(f"names target {value[0]} twice: a length goes from one target to another")
    return value


def _one_or_many(value: Any) -> Any:
    return [_file_alone(item) for item in (value if isinstance(value, list) else [value])]


class ScaleBarEntry(Entry):
    """A known distance between two targets."""

    targets: Annotated[tuple[Whole, Whole], BeforeValidator(_pair)]
    length_mm: Positive
    sigma_mm: Positive


class CheckLengthEntry(Entry):
    """A distance that is only compared."""

    targets: Annotated[tuple[Whole, Whole], BeforeValidator(_pair)]
    length_mm: Positive
    sigma_mm: NotNegative | None = None


class FixedDatum(Entry):
    """Targets whose coordinates fix the datum."""

    fixed: list[Whole]


class SurveyEntry(Entry):
    """A free-hand image set of a body, or marks measured by another program.

    With ``tiles`` (a grid file) ``images`` holds lists of tiles.
    """

    images: Text | None = None
    tiles: Text | None = None
    observations: Text | None = None
    camera: Text | None = None
    size_px: tuple[Whole, Whole] | None = None
    scale_bars: list[ScaleBarEntry] = Field(default_factory=list)
    check_lengths: list[CheckLengthEntry] = Field(default_factory=list)
    datum: Literal["free", "bars"] | FixedDatum = "free"

    @property
    def ends(self) -> frozenset[int]:
        """Targets of scale bars and check lengths."""
        pairs = [*(bar.targets for bar in self.scale_bars), *(length.targets for length in self.check_lengths)]
        return frozenset(number for pair in pairs for number in pair)


class BodyUse(Entry):
    """A body of the campaign."""

    targets: Text
    survey: SurveyEntry | None = None


class StationCameraEntry(Entry):
    """A camera that watches the robot; with ``tiles`` (a grid file) ``images`` holds lists of tiles."""

    images: Text | None = None
    tiles: Text | None = None
    observations: Text | None = None
    calibration: Text | None = None
    size_px: tuple[Whole, Whole] | None = None


class StationEntry(Entry):
    """The cameras that watch the robot and the body that it carries."""

    cameras: dict[str, StationCameraEntry]
    body: Text


class HandEyeCameraEntry(StationCameraEntry):
    """The camera of a hand-eye calibration: an image per pose; ``hold`` keeps its calibration as it is."""

    name: Text = "camera"
    hold: bool = False


class HandEyeEntry(Entry):
    """A camera in the hand of the robot, or beside it, and the board that it sees.

    ``flange`` is a table of flange frames in base coordinates, in place of a robot and its joint angles.
    """

    camera: HandEyeCameraEntry
    mounted: Literal["hand", "world"] = "hand"
    board: Text
    flange: Text | None = None
    board_scale_ppm: Positive | None = None


class QualityEntry(Entry):
    """Limits."""

    distance_tolerance_mm: Positive | None = None


class ModelEntry(Entry):
    """Choices of the identification."""

    parameters: Literal["standard", "geometry", "table5.4", "none"] | list[Text] = "standard"
    objective: Literal["maximum_likelihood", "basis_norm"] = "maximum_likelihood"
    robust: bool = True
    statics: Literal["one_step", "converged"] = "converged"
    joint_sigma_deg: NotNegative | None = None
    adjustment: Literal["staged", "joint"] = "staged"
    priors: dict[Text, Positive] = Field(default_factory=dict)


class BundleEntry(Entry):
    """Choices of the bundle adjustment."""

    engine: Literal["robcal", "pycolmap"] = "robcal"


class DiagnosisEntry(Entry):
    """Choices of the diagnosis."""

    enabled: bool = True
    level: Annotated[float, Field(gt=0, lt=0.5)] = 0.01


def _file_alone(value: Any) -> Any:
    return {"file": value} if isinstance(value, str) else value


class RobotUse(Entry):
    """The nominal robot; the links choose a chain of a URDF."""

    file: Text
    base_link: Text | None = None
    tip_link: Text | None = None


class TableUse(Entry):
    """A table, and how to read one of another program; ``line_cameras``, ``sensor``: whose raw readings it holds."""

    file: Text
    columns: dict[Text, Text] = Field(default_factory=dict)
    sep: Literal[",", ";", "|", ":", "\t", "\\t", "tab", "space", " "] = ","
    decimal: Literal[".", ","] = "."
    skip_rows: Annotated[int, Field(ge=0, le=100_000)] = 0
    header: bool = True
    orientation: Orientation = "rpy"
    line_cameras: Text | None = None
    sensor: Text | None = None

    @model_validator(mode="after")
    def _one_kind_of_readings(self) -> Self:
        if self.line_cameras is not None and self.sensor is not None:
            raise ValueError("holds readings of 'line_cameras' or of a 'sensor': state one of them")
        return self

    def table_map(self) -> TableMap | None:
        """How to read the table; None where it is one of the project's own."""
        given = self.model_dump(exclude={"file", "line_cameras", "sensor"}, exclude_defaults=True)
        return TableMap(**given) if given else None


Tables = Annotated[list[TableUse], BeforeValidator(_one_or_many)]

Coordinate = Literal["x", "y", "z", "roll", "pitch", "yaw"]


class CellFrameEntry(Entry):
    """World or tool of an instrument: what is known of it; what is not stated is free."""

    xyz_mm: Triple | None = None
    rpy_deg: Triple | None = None
    free: Literal["all", "none"] | list[Coordinate] | None = None
    sigma_mm: Positive | None = None
    sigma_deg: Positive | None = None


class PulleyEntry(Entry):
    """A wheel over which a wire leaves; its radius may be identified."""

    radius_mm: Positive
    axis: Triple = (0.0, 0.0, 1.0)
    free: Literal["none", "radius"] = "none"


class InstrumentEntry(Entry):
    """A measuring system with a world and a tool of its own."""

    measurements: Tables
    world_T_base: CellFrameEntry | None = None
    flange_T_tool: CellFrameEntry | None = None
    pulley: PulleyEntry | None = None
    tension_N: Positive | None = None
    correction: Text | None = None
    mounted: Literal["world", "hand"] = "world"
    body: Text | None = None


class CampaignEntry(Entry):
    """The whole file."""

    format: Literal["robcal/campaign-1"]
    name: Annotated[str, BeforeValidator(_folder_name)]
    robot: Annotated[RobotUse | None, BeforeValidator(_file_alone)] = None
    poses: Annotated[TableUse | None, BeforeValidator(_file_alone)] = None
    payloads: dict[str, PayloadEntry] = Field(default_factory=dict)
    bodies: dict[str, BodyUse] = Field(default_factory=dict)
    station: StationEntry | None = None
    hand_eye: HandEyeEntry | None = None
    quality: QualityEntry = QualityEntry()
    tolerance_mm: Positive | None = None
    measurements: Tables = Field(default_factory=list)
    body: Text | None = None
    instruments: dict[Annotated[str, BeforeValidator(_instrument_name)], InstrumentEntry] = Field(default_factory=dict)
    same_world: list[list[Text]] = Field(default_factory=list)
    same_tool: list[list[Text]] = Field(default_factory=list)
    world_T_base: CellFrameEntry | None = None
    flange_T_tool: CellFrameEntry | None = None
    model: ModelEntry = ModelEntry()
    bundle: BundleEntry = BundleEntry()
    diagnosis: DiagnosisEntry = DiagnosisEntry()

"""Descriptions of a cell for measuring poses (format robcal/poses-1): the entries as a person writes them."""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from robcal.calibration.collision import Ball, Box, Capsule, HalfSpace, Obstacle
from robcal.errors import InvalidInput
from robcal.files.placement import PayloadEntry, PlacementEntry
from robcal.files.schemas import Entry, NotNegative, Number, Positive, Text, Triple, Whole

FORMAT = "robcal/poses-1"


def _targets_alone(value: Any) -> Any:
    return {"targets": value} if isinstance(value, str) else value


class BodyPart(Entry):
    """What the robot carries to be measured, or what a sensor in its hand looks at."""

    targets: Text
    flange_T_body: PlacementEntry = PlacementEntry()
    facing: Triple = (0.0, 0.0, 1.0)


class VisibilityPart(Entry):
    """When a pose counts as visible."""

    cameras: Whole = 2
    targets: Whole = 3
    incidence_deg: Positive = 60.0
    margin_px: NotNegative = 15.0
    diameter_px: NotNegative = 5.0


class CapsulePart(Entry):
    """A link's hull: all points within the radius of a segment."""

    frame: Text
    start_mm: Triple = (0.0, 0.0, 0.0)
    end_mm: Triple
    radius_mm: Positive


class ObstaclePart(Entry):
    """A simple body in base coordinates."""

    kind: Literal["floor", "box", "ball", "capsule"]
    height_mm: Number | None = None
    xyz_mm: Triple | None = None
    rpy_deg: Triple = (0.0, 0.0, 0.0)
    size_mm: tuple[Positive, Positive, Positive] | None = None
    radius_mm: Positive | None = None
    start_mm: Triple | None = None
    end_mm: Triple | None = None

    def obstacle(self, where: str) -> Obstacle:
        """The body in SI units."""
        needed = {
            "floor": ("height_mm",),
            "box": ("xyz_mm", "size_mm"),
            "ball": ("xyz_mm", "radius_mm"),
            "capsule": ("start_mm", "end_mm", "radius_mm"),
        }[self.kind]
        for key in needed:
            if getattr(self, key) is None:
                raise InvalidInput(f"{where}: a {self.kind} needs {', '.join(needed)}; {key} is missing")
        if self.kind == "floor":
            return HalfSpace((0.0, 0.0, 1.0), float(self.height_mm or 0.0) / 1000)
        if self.kind == "box":
            placement = PlacementEntry(xyz_mm=given(self.xyz_mm), rpy_deg=self.rpy_deg)
            return Box(placement.matrix(), metres(given(self.size_mm)))
        radius = float(self.radius_mm or 0.0) / 1000
        if self.kind == "ball":
            return Ball(metres(given(self.xyz_mm)), radius)
        return Capsule("base", metres(given(self.start_mm)), metres(given(self.end_mm)), radius)


class CollisionPart(Entry):
    """Links and surroundings."""

    link_radius_mm: Positive | None = None
    capsules: list[CapsulePart] = Field(default_factory=list)
    clearance_mm: NotNegative = 20.0
    obstacles: list[ObstaclePart] = Field(default_factory=list)


class ChoicePart(Entry):
    """How many poses and by what they are chosen."""

    method: Literal["d_optimal", "worst_case", "equidistant"] = "d_optimal"
    count: Whole = 80
    accuracy_mm: Positive | None = None
    verify: Whole = 0
    parameters: Literal["standard", "geometry", "table5.4"] | list[Text] = "standard"
    candidates: Whole = 800
    range_margin: NotNegative = 0.02
    seed: Whole = 0


class MeasuringPart(Entry):
    """Accuracy of the measurement: of an image point, and of a frame beside that."""

    sigma_px: Positive = 0.05
    sigma_mm: Positive = 0.05
    sigma_deg: Positive = 0.006


class SensorPart(Entry):
    """A sensor in the hand: how far from a target it measures, half the opening of its view, where it sits."""

    distance_mm: Positive
    cone_deg: NotNegative = 0.0
    flange_T_sensor: PlacementEntry | None = None


class HandEyePart(Entry):
    """A hand-eye calibration: the ``run`` that is to become sharper, or camera, board, and where they are about."""

    run: Text | None = None
    camera: Text | None = None
    board: Text | None = None
    mounted: Literal["hand", "world"] = "hand"
    distance_mm: tuple[Positive, Positive] | None = None
    flange_T_camera: PlacementEntry | None = None
    base_T_camera: PlacementEntry | None = None
    base_T_board: PlacementEntry | None = None
    flange_T_board: PlacementEntry | None = None


class PosesEntry(Entry):
    """The whole file."""

    format: Literal["robcal/poses-1"]
    robot: Text
    payloads: dict[str, PayloadEntry] = Field(default_factory=dict)
    payload: Text | None = None
    world_T_base: PlacementEntry = PlacementEntry()
    body: Annotated[BodyPart | None, BeforeValidator(_targets_alone)] = None
    sensor: SensorPart | None = None
    hand_eye: HandEyePart | None = None
    base_T_body: PlacementEntry | None = None
    cameras: dict[str, Text] = Field(default_factory=dict)
    visibility: VisibilityPart = VisibilityPart()
    collision: CollisionPart = CollisionPart()
    choice: ChoicePart = ChoicePart()
    measuring: MeasuringPart = MeasuringPart()
    test_points_mm: list[Triple] = Field(default_factory=lambda: [(0.0, 0.0, 0.0), (200.0, 200.0, 400.0)])
    start: list[Number] | None = None


def metres(values: Sequence[float]) -> tuple[float, float, float]:
    """Three millimetres in metres."""
    x, y, z = (float(v) / 1000 for v in values)
    return x, y, z


def given(values: tuple[float, float, float] | None) -> tuple[float, float, float]:
    """Three numbers, zero where none are stated."""
    return (0.0, 0.0, 0.0) if values is None else values

"""Command poses: a description of the cell (format robcal/poses-1) in, a table of measuring poses out."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from robcal.calibration.collision import Ball, Box, Capsule, HalfSpace, Obstacle, link_capsules
from robcal.calibration.pose_candidates import Cell
from robcal.calibration.poses import PosePlan, PoseRequest
from robcal.calibration.poses import generate_poses as plan_poses
from robcal.calibration.visibility import Viewpoint, VisibilityRules
from robcal.errors import InvalidInput
from robcal.files.body_file import body_from_file, read_body
from robcal.files.camera_file import read_camera
from robcal.files.poses_table import joint_columns
from robcal.files.robot_file import PayloadEntry, PlacementEntry
from robcal.files.robot_import import read_any_robot
from robcal.files.schemas import Entry, NotNegative, Number, Positive, Text, Triple, Whole, read_entry
from robcal.files.tables import write_table
from robcal.robot.model import RobotModel
from robcal.transforms import Array

FORMAT = "robcal/poses-1"


class BodyPart(Entry):
    """What the robot carries to be measured."""

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
            placement = PlacementEntry(xyz_mm=_given(self.xyz_mm), rpy_deg=self.rpy_deg)
            return Box(placement.matrix(), _metres(_given(self.size_mm)))
        radius = float(self.radius_mm or 0.0) / 1000
        if self.kind == "ball":
            return Ball(_metres(_given(self.xyz_mm)), radius)
        return Capsule("base", _metres(_given(self.start_mm)), _metres(_given(self.end_mm)), radius)


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


class PosesEntry(Entry):
    """The whole file."""

    format: Literal["robcal/poses-1"]
    robot: Text
    payloads: dict[str, PayloadEntry] = Field(default_factory=dict)
    payload: Text | None = None
    world_T_base: PlacementEntry = PlacementEntry()
    body: BodyPart | None = None
    cameras: dict[str, Text] = Field(default_factory=dict)
    visibility: VisibilityPart = VisibilityPart()
    collision: CollisionPart = CollisionPart()
    choice: ChoicePart = ChoicePart()
    measuring: MeasuringPart = MeasuringPart()
    test_points_mm: list[Triple] = Field(default_factory=lambda: [(0.0, 0.0, 0.0), (200.0, 200.0, 400.0)])
    start: list[Number] | None = None


def generate_poses(config: Path, out: Path) -> dict[str, Any]:
    """Write measuring poses for a cell, and beside them the path with the points to drive through.

    Raises
    ------
    InvalidInput : the description contradicts itself, or no pose of the cell can be measured.
    """
    request = read_request(config)
    try:
        plan = plan_poses(request)
    except InvalidInput as problem:
        raise InvalidInput(f"{config}: {problem}") from problem
    names = [f"p{k:03d}" for k in range(1, len(plan.q) + 1)]
    write_table(out, _columns(request, plan, names))
    path = out.with_name(f"{out.stem}_path{out.suffix or '.csv'}")
    write_table(path, _path_columns(request.model, plan, names))
    warnings = []
    if not plan.reached and request.accuracy is not None:
        warnings.append(
            f"{config}: {int(np.sum(~plan.verify))} poses reach {1e3 * plan.predicted[1]:.3f} mm at the worst place, "
            f"not the wanted {1e3 * request.accuracy:.3f} mm: allow more poses (count), or measure better"
        )
    return {
        "poses": len(plan.q),
        "verify": int(np.sum(plan.verify)),
        "predicted_mean_mm": 1e3 * plan.predicted[0],
        "predicted_worst_mm": 1e3 * plan.predicted[1],
        "accuracy_reached": plan.reached,
        "tried": plan.tried,
        "refused": plan.rejected,
        "out": str(out),
        "path": str(path),
        "warnings": warnings,
    }


def read_request(config: Path) -> PoseRequest:
    """What a file of the format robcal/poses-1 asks for; other files are named relative to it.

    Raises
    ------
    InvalidInput : the file, or one that it names, contradicts the contract.
    """
    entry, _ = read_entry(config, PosesEntry, FORMAT)
    folder = config.parent
    model = read_any_robot(folder / entry.robot)
    payloads = {**model.payloads, **{name: p.payload() for name, p in entry.payloads.items()}}
    model = RobotModel(
        model.name,
        model.frames,
        model.gravity,
        model.gravity_frame,
        model.parameters,
        model.terms,
        payloads,
        model.world_T_base,
        model.flange_T_tool,
    )
    choice, measuring = entry.choice, entry.measuring
    start = None
    if entry.start is not None:
        if len(entry.start) != model.n_joints:
            raise InvalidInput(f"{config}: start has {len(entry.start)} values, the robot {model.n_joints} joints")
        start = np.array([v * factor for v, (_, factor) in zip(entry.start, joint_columns(model), strict=True)])
    parameters = choice.parameters if isinstance(choice.parameters, str) else tuple(choice.parameters)
    return PoseRequest(
        model=model,
        cell=_cell(entry, config, model),
        method=choice.method,
        count=choice.count,
        accuracy=None if choice.accuracy_mm is None else choice.accuracy_mm / 1000,
        verify=choice.verify,
        parameters=parameters,
        payload=entry.payload,
        sigma_px=measuring.sigma_px,
        sigma=(measuring.sigma_mm / 1000, float(np.deg2rad(measuring.sigma_deg))),
        test_points=tuple(_metres(p) for p in entry.test_points_mm),
        candidates=choice.candidates,
        margin=choice.range_margin,
        seed=choice.seed,
        start=start,
    )


def _cell(entry: PosesEntry, config: Path, model: RobotModel) -> Cell:
    folder = config.parent
    views = []
    for name, file in entry.cameras.items():
        content = read_camera(folder / file)
        if content.world_T_camera is None:
            raise InvalidInput(f"{folder / file}: world_T_camera is missing: where camera {name} stands must be known")
        views.append(Viewpoint(name, content.camera, content.world_T_camera))
    if views and entry.body is None:
        raise InvalidInput(f"{config}: cameras are given but no body for them to see: name its targets under body")
    body = None
    flange_T_body, facing = np.eye(4), (0.0, 0.0, 1.0)
    if entry.body is not None:
        body = body_from_file(Path(entry.body.targets).stem, read_body(folder / entry.body.targets))
        flange_T_body, facing = entry.body.flange_T_body.matrix(), entry.body.facing
        if not any(facing):
            raise InvalidInput(f"{config}: body.facing is a direction, it must not be zero")
    rules = entry.visibility
    if views and rules.cameras > len(views):
        raise InvalidInput(f"{config}: visibility.cameras asks for {rules.cameras} cameras, {len(views)} are given")
    collision = entry.collision
    radius = None if collision.link_radius_mm is None else collision.link_radius_mm / 1000
    capsules = tuple(
        Capsule(c.frame, _metres(c.start_mm), _metres(c.end_mm), c.radius_mm / 1000) for c in collision.capsules
    )
    obstacles = tuple(
        o.obstacle(f"{config}: collision.obstacles[{k}]") for k, o in enumerate(collision.obstacles, start=1)
    )
    return Cell(
        world_T_base=entry.world_T_base.matrix(),
        flange_T_body=flange_T_body,
        body=body,
        viewpoints=tuple(views),
        rules=VisibilityRules(
            cameras=rules.cameras,
            targets=rules.targets,
            incidence=float(np.deg2rad(rules.incidence_deg)),
            margin_px=rules.margin_px,
            diameter_px=rules.diameter_px,
            facing=facing,
        ),
        capsules=capsules or link_capsules(model, radius),
        obstacles=obstacles,
        clearance=collision.clearance_mm / 1000,
    )


def _columns(request: PoseRequest, plan: PosePlan, names: Sequence[str]) -> dict[str, Sequence[object]]:
    columns: dict[str, Sequence[object]] = {"pose": names, **_joints(request.model, plan.q)}
    if request.payload is not None:
        columns["payload"] = [request.payload] * len(names)
    columns["set"] = ["verify" if v else "identify" for v in plan.verify]
    for k in range(request.model.n_joints):
        columns[f"approach{k + 1}"] = [int(v) for v in plan.approach[:, k]]
    return columns


def _path_columns(model: RobotModel, plan: PosePlan, names: Sequence[str]) -> dict[str, Sequence[object]]:
    """Every pose with the configuration to drive through before it, where its approach needs one."""
    labels: list[str] = []
    rows: list[Array] = []
    for name, via, q in zip(names, plan.via, plan.q, strict=True):
        if np.any(via != q):
            labels.append(f"{name}_via")
            rows.append(via)
        labels.append(name)
        rows.append(q)
    return {"pose": labels, **_joints(model, np.array(rows))}


def _joints(model: RobotModel, q: Array) -> dict[str, Sequence[object]]:
    return {name: [f"{v:.6f}" for v in q[:, k] / factor] for k, (name, factor) in enumerate(joint_columns(model))}


def _metres(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (float(v) / 1000 for v in values)
    return x, y, z


def _given(values: tuple[float, float, float] | None) -> tuple[float, float, float]:
    return (0.0, 0.0, 0.0) if values is None else values

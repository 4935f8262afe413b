"""Command poses: a description of the cell (format robcal/poses-1) in, a table of measuring poses out."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.hand_eye_poses import write_views
from pipeline.pose_request_of_run import describe_run
from pipeline.pose_schema import FORMAT, PosesEntry, metres
from robcal.calibration.collision import Capsule, Obstacle, link_capsules
from robcal.calibration.pose_candidates import Cell
from robcal.calibration.poses import PosePlan, PoseRequest
from robcal.calibration.poses import generate_poses as plan_poses
from robcal.calibration.sensor_poses import SensorRequest, sensor_poses
from robcal.calibration.visibility import Viewpoint, VisibilityRules
from robcal.errors import InvalidInput
from robcal.files.body_file import body_from_file, read_body
from robcal.files.camera_file import read_camera
from robcal.files.poses_table import joint_columns
from robcal.files.robot_import import read_any_robot
from robcal.files.schemas import read_entry
from robcal.files.tables import write_table
from robcal.photogrammetry.core.bodies import Body, fit_sphere
from robcal.robot.model import RobotModel
from robcal.transforms import Array, invert

RADIUS_TOLERANCE = 1e-3
"""m; targets of a sphere may be on another radius than stated by this, for want of care in the file."""


def generate_poses(config: Path, out: Path) -> dict[str, Any]:
    """Write measuring poses for a cell, and beside them the path with the points to drive through.

    Of a run folder in place of a description one is written beside the poses, with the run's robot, base and tool.

    Raises
    ------
    InvalidInput : the description contradicts itself, or no pose of the cell can be measured.
    """
    if config.is_dir():
        run, config = config, out.with_name(f"{out.stem}_cell.yaml")
        describe_run(run, config)
    entry = read_entry(config, PosesEntry, FORMAT)[0]
    if entry.sensor is not None:
        return _generate_sensor_poses(config, out)
    if entry.hand_eye is not None:
        model = _robot(entry, config)
        return write_views(entry, config, out, model, _bodies(entry, config, model))
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
    model = _robot(entry, config)
    choice, measuring = entry.choice, entry.measuring
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
        test_points=tuple(metres(p) for p in entry.test_points_mm),
        candidates=choice.candidates,
        margin=choice.range_margin,
        seed=choice.seed,
        start=_start(entry, config, model),
    )


def read_sensor_request(config: Path) -> SensorRequest:
    """What a file with a ``sensor`` asks for; a calibrated robot's file gives frames that are not stated.

    Raises
    ------
    InvalidInput : the file, or one that it names, contradicts the contract.
    """
    entry, _ = read_entry(config, PosesEntry, FORMAT)
    sensor = entry.sensor
    if sensor is None or entry.body is None:
        raise InvalidInput(f"{config}: a sensor looks at the targets of a body: name it, 'body: sphere.yaml'")
    if entry.cameras:
        raise InvalidInput(f"{config}: cameras and a sensor in the hand are two ways of measuring: keep one of them")
    if sensor.cone_deg >= 60:
        raise InvalidInput(f"{config}: sensor.cone_deg is {sensor.cone_deg:g}: half an opening is below 60 degrees")
    model, choice = _robot(entry, config), entry.choice
    frames: dict[str, Array] = {}
    for key, stated, known in (
        ("base_T_body", entry.base_T_body, None if model.world_T_base is None else invert(model.world_T_base)),
        ("sensor.flange_T_sensor", sensor.flange_T_sensor, model.flange_T_tool),
    ):
        if stated is None and known is None:
            raise InvalidInput(f"{config}: {key} is missing, and {entry.robot} is no calibrated robot that has it")
        frames[key] = stated.matrix() if stated is not None else np.asarray(known)
    file = read_body(config.parent / entry.body.targets)
    body = body_from_file(Path(entry.body.targets).stem, file)
    _check_radius(body, file.radius, file.path)
    capsules, obstacles = _bodies(entry, config, model)
    return SensorRequest(
        model=model,
        body=body,
        base_T_body=frames["base_T_body"],
        flange_T_sensor=frames["sensor.flange_T_sensor"],
        distance=sensor.distance_mm / 1000,
        cone=float(np.deg2rad(sensor.cone_deg)),
        count=choice.count,
        verify=choice.verify,
        payload=_payload(entry, config, model),
        capsules=capsules,
        obstacles=obstacles,
        clearance=entry.collision.clearance_mm / 1000,
        margin=choice.range_margin,
        start=_start(entry, config, model),
    )


def _generate_sensor_poses(config: Path, out: Path) -> dict[str, Any]:
    request = read_sensor_request(config)
    try:
        plan = sensor_poses(request)
    except InvalidInput as problem:
        raise InvalidInput(f"{config}: {problem}") from problem
    names = [f"p{k:03d}" for k in range(1, len(plan.q) + 1)]
    columns: dict[str, Sequence[object]] = {"pose": names, **_joints(request.model, plan.q)}
    columns["target"] = plan.target.tolist()
    columns["turn_deg"] = [f"{v:.3f}" for v in np.degrees(plan.turn)]
    if request.payload is not None:
        columns["payload"] = [request.payload] * len(names)
    columns["set"] = ["verify" if v else "identify" for v in plan.verify]
    write_table(out, columns)
    warnings = []
    for reason in dict.fromkeys(plan.unreachable.values()):
        ids = ", ".join(str(k) for k, other in plan.unreachable.items() if other == reason)
        warnings.append(f"{config}: no pose looks at target {ids}: {reason}")
    if plan.blocked:
        told = ", ".join(names[k] for k in plan.blocked)
        warnings.append(f"{config}: the straight move to {told} collides: lead the robot there by points of your own")
    if len(names) < request.count + request.verify:
        warnings.append(f"{config}: {request.count + request.verify} poses are wanted, the robot has {len(names)}")
    return {
        "poses": len(names),
        "verify": int(np.sum(plan.verify)),
        "targets": len(np.unique(plan.target)),
        "unreachable": [{"target": k, "reason": reason} for k, reason in plan.unreachable.items()],
        "travel": plan.travel,
        "out": str(out),
        "warnings": warnings,
    }


def _check_radius(body: Body, radius: float | None, path: Path) -> None:
    """Raise where the targets are on another sphere than the file states."""
    try:
        found = fit_sphere(body.points[body.known])[1]
    except InvalidInput as problem:
        raise InvalidInput(f"{path}: {problem}") from None
    if radius is not None and abs(found - radius) > RADIUS_TOLERANCE:
        raise InvalidInput(
            f"{path}: shape states a radius of {1e3 * radius:g} mm, the targets are on one of {1e3 * found:.2f} mm: "
            "correct the radius or the coordinates"
        )


def _robot(entry: PosesEntry, config: Path) -> RobotModel:
    place = config.parent / entry.robot
    model = read_any_robot(place / "robot_calibrated.yaml" if place.is_dir() else place)
    return replace(model, payloads={**model.payloads, **{name: p.payload() for name, p in entry.payloads.items()}})


def _payload(entry: PosesEntry, config: Path, model: RobotModel) -> str | None:
    if entry.payload is not None and entry.payload not in model.payloads:
        raise InvalidInput(f"{config}: the robot has no payload '{entry.payload}': list it under payloads")
    return entry.payload


def _start(entry: PosesEntry, config: Path, model: RobotModel) -> Array | None:
    if entry.start is None:
        return None
    if len(entry.start) != model.n_joints:
        raise InvalidInput(f"{config}: start has {len(entry.start)} values, the robot {model.n_joints} joints")
    return np.array([v * factor for v, (_, factor) in zip(entry.start, joint_columns(model), strict=True)])


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
    # a calibrated robot gives the frames that are not stated
    stated = "world_T_base" in entry.model_fields_set or model.world_T_base is None
    world_T_base = entry.world_T_base.matrix() if stated else np.asarray(model.world_T_base)
    flange_T_body, facing = np.eye(4), (0.0, 0.0, 1.0)
    if entry.body is not None:
        body = body_from_file(Path(entry.body.targets).stem, read_body(folder / entry.body.targets))
        stated = "flange_T_body" in entry.body.model_fields_set or model.flange_T_tool is None
        flange_T_body = entry.body.flange_T_body.matrix() if stated else np.asarray(model.flange_T_tool)
        facing = entry.body.facing
        if not any(facing):
            raise InvalidInput(f"{config}: body.facing is a direction, it must not be zero")
    rules = entry.visibility
    if views and rules.cameras > len(views):
        raise InvalidInput(f"{config}: visibility.cameras asks for {rules.cameras} cameras, {len(views)} are given")
    capsules, obstacles = _bodies(entry, config, model)
    return Cell(
        world_T_base=world_T_base,
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
        capsules=capsules,
        obstacles=obstacles,
        clearance=entry.collision.clearance_mm / 1000,
    )


def _bodies(entry: PosesEntry, config: Path, model: RobotModel) -> tuple[tuple[Capsule, ...], tuple[Obstacle, ...]]:
    """Hulls of the links and what stands around them."""
    collision = entry.collision
    radius = None if collision.link_radius_mm is None else collision.link_radius_mm / 1000
    capsules = tuple(
        Capsule(c.frame, metres(c.start_mm), metres(c.end_mm), c.radius_mm / 1000) for c in collision.capsules
    )
    obstacles = tuple(
        o.obstacle(f"{config}: collision.obstacles[{k}]") for k, o in enumerate(collision.obstacles, start=1)
    )
    return capsules or link_capsules(model, radius), obstacles


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

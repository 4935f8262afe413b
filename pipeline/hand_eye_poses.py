"""Command poses for a hand-eye calibration: views of a board that tell most, before the first image or after a run."""

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artifacts import HAND_EYE
from pipeline.pose_schema import HandEyePart, PosesEntry
from pipeline.runs import open_run
from robcal.calibration.collision import Capsule, Obstacle
from robcal.calibration.pose_candidates import Cell, check_poses
from robcal.errors import InvalidInput
from robcal.files.body_file import body_from_file, read_body
from robcal.files.camera_file import read_camera
from robcal.files.poses_table import joint_columns
from robcal.files.tables import write_table
from robcal.handeye.next_poses import ViewRequest, information_of, propose_views
from robcal.handeye.unknowns import Variances
from robcal.robot.model import RobotModel
from robcal.transforms import Array

Around = tuple[tuple[Capsule, ...], tuple[Obstacle, ...]]


def write_views(entry: PosesEntry, config: Path, out: Path, model: RobotModel, around: Around) -> dict[str, Any]:
    """Write the poses that an entry ``hand_eye`` asks for.

    Raises
    ------
    InvalidInput : camera, board or their frames are missing, or no view can be reached.
    """
    part = entry.hand_eye
    assert part is not None
    clearance = entry.collision.clearance_mm / 1000
    cell = Cell(np.eye(4), np.eye(4), capsules=around[0], obstacles=around[1], clearance=clearance)
    request = _request(part, entry, config, model, cell)
    try:
        plan = propose_views(request)
    except InvalidInput as problem:
        raise InvalidInput(f"{config}: {problem}") from problem
    number = min(entry.choice.count, len(plan.q))
    verify = [k % 4 == 3 and k // 4 < entry.choice.verify for k in range(len(plan.q))]
    names = [f"h{k:03d}" for k in range(1, len(plan.q) + 1)]
    columns: dict[str, Any] = {"pose": names}
    for k, (name, factor) in enumerate(joint_columns(model)):
        columns[name] = [f"{v:.6f}" for v in plan.q[:, k] / factor]
    columns["set"] = ["verify" if v else "identify" for v in verify]
    write_table(out, columns)
    warnings = []
    if len(plan.q) < entry.choice.count + entry.choice.verify:
        warnings.append(f"{config}: only {len(plan.q)} views of the board can be reached")
    return {
        "poses": len(names),
        "verify": sum(verify),
        "identify": number,
        "tried": plan.tried,
        "reachable": plan.reachable,
        "sigma_mm": (1e3 * plan.sigma[:3]).tolist(),
        "sigma_deg": np.degrees(plan.sigma[3:6]).tolist(),
        "out": str(out),
        "warnings": warnings,
    }


def _request(part: HandEyePart, entry: PosesEntry, config: Path, model: RobotModel, cell: Cell) -> ViewRequest:
    choice = entry.choice
    distance = None if part.distance_mm is None else (part.distance_mm[0] / 1e3, part.distance_mm[1] / 1e3)
    if distance is not None and distance[0] > distance[1]:
        raise InvalidInput(f"{config}: hand_eye.distance_mm is [nearest, farthest]: exchange the two")
    wanted: dict[str, Any] = {
        "model": model,
        "count": choice.count + choice.verify,
        "candidates": choice.candidates,
        "distance": distance,
        "free": lambda q: check_poses(model, cell, q),
        "seed": choice.seed,
    }
    if part.run is not None:
        kept = open_run(config.parent / part.run).find(HAND_EYE)
        if kept is None:
            raise InvalidInput(f"{config}: {part.run} holds no hand-eye calibration: name its run folder")
        found, data = kept.found, kept.data
        seen = data.select(found.used)
        pixel = found.variances.pixel * float(np.sqrt(np.median(np.trace(data.covariance, axis1=1, axis2=2)) / 2))
        variances = Variances(pixel, found.variances.place, found.variances.turn)
        known = information_of(seen, found.X, found.Z, found.variances).sum(axis=0)
        wanted |= {"camera": found.camera, "body": data.body, "mounted": found.mounted, "X": found.X, "Z": found.Z}
        return ViewRequest(**wanted, information=known, variances=variances)
    if part.camera is None or part.board is None:
        raise InvalidInput(f"{config}: hand_eye needs a 'run', or 'camera', 'board' and where they are about")
    X, Z = _frames(part, config)
    variances = Variances(entry.measuring.sigma_px, 1e-4, 2e-4)
    camera = read_camera(config.parent / part.camera).camera
    body = body_from_file(Path(part.board).stem, read_body(config.parent / part.board))
    return ViewRequest(**wanted, camera=camera, body=body, mounted=part.mounted, X=X, Z=Z, variances=variances)


def _frames(part: HandEyePart, config: Path) -> tuple[Array, Array]:
    names = ("flange_T_camera", "base_T_board") if part.mounted == "hand" else ("base_T_camera", "flange_T_board")
    frames = []
    for name in names:
        stated = getattr(part, name)
        if stated is None:
            raise InvalidInput(f"{config}: hand_eye.{name} is missing: where it is about, centimetres suffice")
        frames.append(stated.matrix())
    return frames[0], frames[1]

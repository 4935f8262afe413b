"""Stage hand_eye: where a camera sits in the hand of the robot, or beside it, from images of a board."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.adjusted_images import findings_of
from pipeline.artifacts import CALIBRATED, DETECTED, HAND_EYE, IDENTIFICATION
from pipeline.bodies import surveyed_or_given
from pipeline.campaign import Campaign, HandEyeSource
from pipeline.campaign_schema import HandEyeEntry
from pipeline.detected_images import load_detections, sizes
from pipeline.json_io import write_json
from pipeline.runs import Run
from pipeline.stages.base import Context, Outcome, Stage
from pipeline.stages.survey import located, size_of_marks
from robcal.calibration.calibrated import CalibratedRobot
from robcal.diagnosis.content import with_images
from robcal.errors import InvalidInput, RobcalError
from robcal.files.camera_file import CameraFile, write_camera
from robcal.files.hand_eye_files import NamedFrame, frame_numbers, write_exports
from robcal.files.poses_table import Poses
from robcal.files.robot_file import write_robot
from robcal.handeye.calibration import Options, calibrate
from robcal.handeye.data import HandEyeData, RobotParameters
from robcal.handeye.result import HandEye
from robcal.handeye.robot import calibrated_robot
from robcal.imaging.detections import Detections
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.identify.targets import coded_rows
from robcal.photogrammetry.station.identify import identify_station
from robcal.photogrammetry.station.network import StationMarks
from robcal.physics.hand_eye import moved_content
from robcal.robot.kernel import Kernel

NAME = "hand_eye"


@dataclass(frozen=True)
class HandEyeRun:
    """What the stage keeps: the calibration, the robot that it is for, and what it was calibrated from.

    ``data`` holds the images with marks, in the order of the poses; ``poses`` their names. ``robot`` is None where
    flange frames were given.
    """

    found: HandEye
    robot: CalibratedRobot | None
    data: HandEyeData = field(repr=False)
    poses: tuple[str, ...] = ()


def work(context: Context) -> Outcome:
    """Calibrate, write camera, robot and exports."""
    campaign, run = context.campaign, context.run
    entry, source, poses = _inputs(campaign)
    body = surveyed_or_given(campaign, run, entry.board)
    size = _size(source, run, entry.camera.name)
    marks, notes = _marks(campaign, run, source, body, poses, entry)
    camera = source.images.start.camera if source.images.start else Camera.from_size(*size)
    robot = _robot(campaign, run, poses)
    given = source.base_T_flange
    at = body.index(marks.target)
    seen = at >= 0
    seen[seen] = body.known[at[seen]]
    if not seen.any():
        raise InvalidInput(f"{campaign.path}: none of the marks is of board '{entry.board}': check the ids")
    data = HandEyeData(
        camera=camera,
        mounted=entry.mounted,
        base_T_flange=given if robot is None and given is not None else _flanges(robot),
        body=body,
        image=marks.pose[seen],
        target=at[seen],
        xy=marks.xy[seen],
        covariance=marks.covariance[seen],
        robot=robot,
        scale_sigma=None if entry.board_scale_ppm is None else 1e-6 * entry.board_scale_ppm,
    )
    options = Options(
        hold_camera=entry.camera.hold,
        start_camera=source.images.start is not None,
        adjust_robot=campaign.entry.model.parameters != "none" and not campaign.measures_robot,
    )
    try:
        found = calibrate(data, options, poses.verify)
    except RobcalError as error:
        raise located(error, f"{campaign.path}: hand_eye") from None
    kept = HandEyeRun(found, calibrated_robot(found, data), replace(data, robot=None), poses.names)
    return _outcome(campaign, run, kept, notes)


def _inputs(campaign: Campaign) -> tuple[HandEyeEntry, HandEyeSource, Poses]:
    entry, source, poses = campaign.entry.hand_eye, campaign.hand_eye, campaign.poses
    if entry is None or source is None or poses is None:
        raise InvalidInput(f"{campaign.path}: no hand-eye calibration: add 'hand_eye' with camera and board")
    return entry, source, poses


def _size(source: HandEyeSource, run: Run, name: str) -> tuple[int, int]:
    if source.images.marks is not None:
        return source.images.size or size_of_marks(source.images.marks)
    return sizes(run.load(DETECTED), f"hand_eye/{name}")


def _marks(
    campaign: Campaign, run: Run, source: HandEyeSource, body: Body, poses: Poses, entry: HandEyeEntry
) -> tuple[StationMarks, list[str]]:
    """Identified marks with the numbers of their poses."""
    place = {name: i for i, name in enumerate(poses.names)}
    table = source.images.marks
    if table is not None:
        pose = np.array([place[image] for image in table.image], dtype=np.int64)
        return StationMarks(pose, table.target, table.xy, table.sigma[:, None, None] ** 2 * np.eye(2)), []
    name = entry.camera.name
    found = load_detections(run, run.load(DETECTED), f"hand_eye/{name}")
    if campaign.bodies[entry.board].file.board is not None:
        return _on_board({place[image]: each for image, each in found.items()}, body, campaign), []
    start = source.images.start.camera if source.images.start else None
    identified = identify_station({name: {place[image]: each for image, each in found.items()}}, body, {name: start})
    marks = identified.marks.get(name)
    if marks is None or not len(marks):
        why = next((reason for _, _, reason in identified.problems), "no targets found")
        raise InvalidInput(f"{campaign.path}: hand_eye: board '{body.name}' is in no image of '{name}': {why}")
    return marks, [f"pose '{poses.names[p]}': board not identified: {why}" for _, p, why in identified.problems]


def _on_board(found: Mapping[int, Detections], body: Body, campaign: Campaign) -> StationMarks:
    """Marks of a printed board, whose detector numbers them: pose, id, place and covariance."""
    parts = []
    for pose, each in sorted(found.items()):
        rows, ids = coded_rows(each, body)
        parts.append((np.full(len(rows), pose, dtype=np.int64), ids, each.xy[rows], each.covariance[rows]))
    if not sum(len(part[0]) for part in parts):
        raise InvalidInput(f"{campaign.path}: hand_eye: board '{body.name}' is in no image: is its file right?")
    numbers, target, xy, covariance = (np.concatenate(column) for column in zip(*parts, strict=True))
    return StationMarks(numbers, target, xy, covariance)


def _robot(campaign: Campaign, run: Run, poses: Poses) -> RobotParameters | None:
    """The robot of the campaign; where it was calibrated from other measurements, that one."""
    if campaign.robot is None:
        return None
    measured: CalibratedRobot | None = run.find(CALIBRATED)
    if measured is None:
        identified = run.find(IDENTIFICATION)
        measured = None if identified is None else identified.robot
    if measured is not None:
        model, statics = replace(measured.model, world_T_base=None, flange_T_tool=None), measured.statics
    else:
        model, statics = campaign.robot, campaign.entry.model.statics
    kernel = Kernel(model, statics)
    return RobotParameters.of(kernel, poses.inputs(kernel))


def _flanges(robot: RobotParameters | None) -> np.ndarray:
    assert robot is not None
    return robot.flanges(np.zeros(len(robot.names)))[0]


def frames_of(found: HandEye) -> list[NamedFrame]:
    """Camera and board in their carriers, under their names."""
    camera, board = ("flange", "base") if found.mounted == "hand" else ("base", "flange")
    return [
        NamedFrame(camera, "camera", found.X, found.covariance[:6, :6]),
        NamedFrame(board, "board", found.Z, found.covariance[6:, 6:]),
    ]


def _outcome(campaign: Campaign, run: Run, kept: HandEyeRun, notes: list[str]) -> Outcome:
    entry, found, names = campaign.entry.hand_eye, kept.found, kept.poses
    assert entry is not None
    frames = frames_of(found)
    causes = []
    if found.moved is not None:
        causes = [moved_content(found.moved, entry.board, entry.camera.name, names[found.moved.image])]
    rejected = [{"image": names[r.image], "reason": r.reason.format(*names)} for r in found.rejected]
    outputs = [run.save(HAND_EYE, kept), _write_camera(campaign, run, found)]
    outputs += write_exports(run.folder / "hand_eye", entry.camera.name, found.camera, frames)
    result = {
        **{f.name: frame_numbers(f) for f in frames},
        "mounted": found.mounted,
        "camera": entry.camera.name,
        "board": entry.board,
        "images": int(found.used.sum()),
        "rejected": rejected,
        **_noise(kept),
        "heldout_px": None if found.heldout is None else found.heldout.px,
        "heldout_mm": None if found.heldout is None else found.heldout.mm,
        "heldout_images": 0 if found.heldout is None else found.heldout.images,
        "heldout_kind": None if found.heldout is None else ("folds" if found.heldout.folds else "verify"),
        "board_shape": {n: {"value": v, "sigma": found.shape_sigma[n]} for n, v in found.shape.items()},
        "robot_parameters": len(found.robot_names),
        "causes": [{"cause": c["cause"], "where": c["where"], "parameters": c["parameters"]} for c in causes],
        "converged": found.summary.converged,
    }
    message = [*notes, *(f"image '{r['image']}' is left out: {r['reason']}" for r in rejected), *found.notes]
    message += [str(c["statement"]) for c in causes] + _shape_notes(found, kept.data.body)
    if not found.summary.converged:
        message.append(f"the adjustment did not converge: {found.summary.termination}")
    whole: dict[str, Any] = {NAME: result}
    if not campaign.measures_robot:
        outputs += _diagnosis(campaign, run, causes, found)
        whole["diagnosis"] = {"mismatch": bool(causes), "p_value": 0.0 if causes else 1.0, "causes": result["causes"]}
        if kept.robot is not None:
            write_robot(run.robot, kept.robot.model, f"from the hand-eye calibration of campaign {campaign.name}")
            outputs.append(run.robot)
    return Outcome(whole, outputs, message)


def _noise(kept: HandEyeRun) -> dict[str, float]:
    found, data = kept.found, kept.data
    stated = float(np.sqrt(np.median(np.trace(data.covariance, axis1=1, axis2=2)) / 2.0))
    return {
        "sigma0": found.variances.pixel,
        "noise_px": found.variances.pixel * stated,
        "robot_scatter_mm": 1e3 * found.variances.place,
        "robot_scatter_deg": float(np.degrees(found.variances.turn)),
    }


def _shape_notes(found: HandEye, body: Body) -> list[str]:
    notes = []
    if "scale" in found.shape:
        share, sigma = 100 * found.shape["scale"], 100 * found.shape_sigma["scale"]
        notes.append(
            f"the board is {abs(share):.3f} +- {sigma:.3f} per cent {'larger' if share > 0 else 'smaller'} than its "
            "file says (or the robot's lengths are that much off): measure it, and correct the file"
        )
        # the scale is estimated about the middle of the board, so its frame keeps the origin of the stated size
        off = 1e3 * abs(found.shape["scale"]) * float(np.linalg.norm(body.points[body.known].mean(axis=0)))
        notes.append(
            f"the origin of the board's frame is that of the stated size and lies {off:.2g} mm from the corner of the "
            "real board: run again with the corrected file before the board's frame is used"
        )
    if "bend_xx" in found.shape:
        notes.append("the board is not flat: its bend is estimated with the camera; a stiff board would be better")
    return notes


def _write_camera(campaign: Campaign, run: Run, found: HandEye) -> Path:
    entry, source = campaign.entry.hand_eye, campaign.hand_eye
    assert entry is not None
    assert source is not None
    start = source.images.start
    where = {"flange_T_camera": found.X} if found.mounted == "hand" else {"base_T_camera": found.X}
    content = CameraFile(found.camera, None, start.pixel_um if start else None, dict(found.camera_sigma), **where)
    path = run.camera(entry.camera.name)
    write_camera(path, content, f"hand-eye calibration of campaign {campaign.name}")
    return path


def _diagnosis(campaign: Campaign, run: Run, causes: list[dict[str, object]], found: HandEye) -> list[Path]:
    """diagnosis.json of a campaign whose robot nothing else measures."""
    images = findings_of(campaign, run)
    content = with_images(None, images.findings, images.scans, images.noise)
    if causes:
        first = causes[0]
        statement = f"{first['statement']}."
        message = statement if not images.findings else f"{content['statement']} {statement}"
        listed = content["causes"]
        content = content | {
            "mismatch": True,
            "p_value": 0.0,
            "statement": message,
            "location": {"stage": first["stage"], "where": first["where"], "direction": None, "poses": []},
            "causes": [*causes, *(listed if isinstance(listed, list) else [])],
        }
    if found.heldout is not None:
        content = content | {"heldout_px": {"before": found.heldout.px, "after": found.heldout.px}}
    write_json(run.diagnosis, content)
    return [run.diagnosis]


STAGE = Stage(
    name=NAME,
    applies=lambda campaign: campaign.entry.hand_eye is not None,
    work=work,
    inputs=lambda campaign: [
        p for p in campaign.files if p.suffix.lower() in {".csv", ".yaml", ".yml", ".urdf", ".xml"}
    ],
    settings=lambda campaign: [
        campaign.entry.model_dump(include={"hand_eye", "robot", "model", "payloads"}),
        list(campaign.poses.names) if campaign.poses else [],
    ],
    after=("detect", "survey", "identify", "diagnose"),
    module=__name__,
)

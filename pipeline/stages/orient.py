"""Stage orient: which dot is which target, and where the station's cameras stand."""

from collections import Counter
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.adjusted_images import image_covariates
from pipeline.artifacts import CORRECTED_IMAGES, DETECTED, MARKS, ORIENTATION, SHAPES
from pipeline.bodies import surveyed_or_given
from pipeline.campaign import Campaign, ImageSource
from pipeline.detected_images import load_detections
from pipeline.result_sections import station_section
from pipeline.runs import Run
from pipeline.stages.base import Context, Outcome, Stage
from pipeline.stages.identify import options_of
from robcal.errors import InvalidInput, RobcalError, located
from robcal.files.camera_file import CameraFile, write_camera
from robcal.files.poses_table import Poses
from robcal.imaging.detections import Detections
from robcal.photogrammetry.core.adjustable import adjustable_names
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera
from robcal.photogrammetry.station.identify import identify_station
from robcal.photogrammetry.station.network import StationMarks, StationOrientation
from robcal.photogrammetry.station.seen_normals import ellipses_of
from robcal.recipe.robot_witness import robot_misfit
from robcal.recipe.station import StationImages, marks_of_table, orient_images
from robcal.recipe.survey import size_of_marks

NAME = "orient"


def work(context: Context) -> Outcome:
    """Identify targets in the station's images and orient its cameras."""
    campaign, run = context.campaign, context.run
    station, poses = campaign.entry.station, campaign.poses
    if station is None or poses is None:
        raise InvalidInput(f"{campaign.path}: no station: add 'station' with its cameras and body")
    body = surveyed_or_given(campaign, run, station.body)
    _check_body(campaign, body, station.body)
    start: dict[str, Camera | None] = {
        name: source.start.camera if source.start else None for name, source in campaign.cameras.items()
    }
    detections = _detections(campaign, run, poses)
    marks, problems = _marks(campaign, detections, body, poses, start)
    notes = _problem_notes(problems, poses)
    marks = _usable(campaign, marks, body, notes, problems)
    images = StationImages(
        poses=poses.names,
        body=body,
        marks=marks,
        shapes={name: ellipses_of(m, detections[name]) for name, m in marks.items() if name in detections},
        start=start,
        stated={
            name: source.start.world_T_camera
            for name, source in campaign.cameras.items()
            if source.start is not None and source.start.world_T_camera is not None and name in marks
        },
        sizes={name: _size(campaign.cameras[name], run, name) for name in marks},
        covariates=image_covariates(campaign),
    )
    robot = campaign.robot
    misfit = None if robot is None else partial(robot_misfit, robot, poses, options_of(campaign, True))
    try:
        found = orient_images(images, campaign.entry.diagnosis.enabled, misfit)
    except RobcalError as error:
        raise located(error, f"{campaign.path}: station") from None
    orientation, marks = found.orientation, dict(found.marks)
    outputs = [run.save(ORIENTATION, orientation), run.save(MARKS, marks)]
    outputs += [run.save(CORRECTED_IMAGES, list(found.corrected)), run.save(SHAPES, dict(images.shapes))]
    outputs += _write_cameras(campaign, run, orientation)
    notes += [f.statement for f in found.corrected] + [e.statement for e in orientation.evidence]
    whole = [r for r in orientation.rejected if r.target < 0]
    notes += [f"camera {r.camera}, pose '{poses.names[r.pose]}': {r.reason}" for r in whole]
    return Outcome({"station": station_section(orientation, marks)}, outputs, notes)


def _check_body(campaign: Campaign, body: Body, name: str) -> None:
    known = int(body.known.sum())
    if known < 3:
        path = campaign.bodies[name].file.path
        raise InvalidInput(
            f"{path}: body '{name}' has {known} targets with coordinates, a station needs three or more: "
            "give coordinates, or a survey of the body"
        )


def _detections(campaign: Campaign, run: Run, poses: Poses) -> dict[str, dict[int, Detections]]:
    """Camera -> pose number -> what was detected in its image."""
    if not any(source.images for source in campaign.cameras.values()):
        return {}
    place = {name: i for i, name in enumerate(poses.names)}
    index = run.load(DETECTED)
    return {
        name: {place[image]: found for image, found in load_detections(run, index, f"station/{name}").items()}
        for name, source in campaign.cameras.items()
        if source.images
    }


def _marks(
    campaign: Campaign,
    detections: Mapping[str, Mapping[int, Detections]],
    body: Body,
    poses: Poses,
    start: Mapping[str, Camera | None],
) -> tuple[dict[str, StationMarks], tuple[tuple[str, int, str], ...]]:
    place = {name: i for i, name in enumerate(poses.names)}
    given = {
        name: marks_of_table(source.marks, body, place)
        for name, source in campaign.cameras.items()
        if source.marks is not None
    }
    if not detections:
        return given, ()
    identified = identify_station(detections, body, start)
    marks = {name: given.get(name) or identified.marks.get(name) for name in campaign.cameras}
    return {name: m for name, m in marks.items() if m is not None}, identified.problems


def _usable(
    campaign: Campaign, marks: Mapping[str, StationMarks], body: Body, notes: list[str], problems: Any
) -> dict[str, StationMarks]:
    """Cameras with any identified target; none at all is an error that says why."""
    used = {name: m for name, m in marks.items() if len(m)}
    for name, source in campaign.cameras.items():
        if name not in used:
            why = next((reason for camera, _, reason in problems if camera == name), "no targets found")
            folder = next(iter(source.images.values())).parent if source.images else name
            message = f"{folder}: no target of body '{body.name}' identified in any image of camera '{name}': {why}"
            if not used:
                raise InvalidInput(f"{message}: are these images of the body, and is it the right body file?")
            notes.append(message)
    return used


def _problem_notes(problems: tuple[tuple[str, int, str], ...], poses: Poses) -> list[str]:
    counts = Counter((camera, reason) for camera, _, reason in problems)
    notes = []
    for (camera, reason), count in counts.items():
        names = [poses.names[p] for c, p, r in problems if (c, r) == (camera, reason)]
        listed = ", ".join(names[:5]) + (", ..." if count > 5 else "")
        notes.append(f"camera {camera}: nothing identified in {count} images ({listed}): {reason}")
    return notes


def _size(source: ImageSource, run: Run, name: str) -> tuple[int, int]:
    if source.marks is not None:
        return source.size or size_of_marks(source.marks)
    index = run.load(DETECTED)
    return index.of(f"station/{name}")[0].size


def _write_cameras(campaign: Campaign, run: Run, orientation: StationOrientation) -> list[Path]:
    placed = orientation.world_T_camera
    paths = []
    for name, camera in zip(orientation.names, orientation.cameras, strict=True):
        _, interior = orientation.camera_covariance(name)
        sigma = np.sqrt(np.clip(np.diag(interior), 0, None))
        start = campaign.cameras[name].start
        content = CameraFile(
            camera,
            placed[name],
            start.pixel_um if start else None,
            {n: float(s) for n, s in zip(INTRINSIC_NAMES, sigma, strict=True) if n in adjustable_names(camera)},
        )
        write_camera(run.camera(name), content, f"oriented in campaign {campaign.name}")
        paths.append(run.camera(name))
    return paths


STAGE = Stage(
    name=NAME,
    applies=lambda campaign: campaign.entry.station is not None,
    work=work,
    inputs=lambda campaign: [
        *(body.file.path for body in campaign.bodies.values()),
        *(source.marks.path for source in campaign.cameras.values() if source.marks is not None),
        *(source.start_path for source in campaign.cameras.values() if source.start_path is not None),
        *((campaign.poses.path,) if campaign.poses is not None else ()),
    ],
    settings=lambda campaign: [
        campaign.entry.model_dump(include={"station", "diagnosis", "model", "payloads"}),
        list(campaign.poses.names) if campaign.poses else [],
    ],
    after=("detect", "survey"),
    module=__name__,
)

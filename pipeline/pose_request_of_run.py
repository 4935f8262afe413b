"""A description of a cell for further measuring poses, from a run: its robot, station cameras and body."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.pose_schema import FORMAT
from robcal.errors import InvalidInput
from robcal.files.body_file import read_body
from robcal.files.camera_file import read_camera
from robcal.files.storage import write_text
from robcal.files.yaml_io import yaml_text

COUNT, VERIFY = 80, 20
COMMENT = "from the run, base and tool included: add obstacles, payload, number of poses, then name it as CONFIG"


def describe_run(run: Path, place: Path) -> None:
    """Write the description; where it lies already it is used as it is, with what a person has added.

    Raises
    ------
    InvalidInput : the folder holds no calibrated robot, or several bodies beside a station.
    """
    if not (run / "robot_calibrated.yaml").is_file():
        raise InvalidInput(f"{run}: holds no robot_calibrated.yaml: name the folder of a run with a robot, or a CONFIG")
    if place.exists():
        return
    to = place.parent.resolve()
    data: dict[str, Any] = {"format": FORMAT, "robot": _from(run, to)}
    cameras = {p.stem: p for p in sorted((run / "cameras").glob("*.yaml")) if read_camera(p).world_T_camera is not None}
    bodies = sorted((run / "bodies").glob("*.yaml"))
    if cameras:
        if len(bodies) != 1:
            names = ", ".join(p.stem for p in bodies) or "none"
            raise InvalidInput(f"{run}: which body the cameras see is not told (bodies: {names}): write a CONFIG")
        data["body"] = {"targets": _from(bodies[0], to), "facing": _facing(bodies[0])}
        data["cameras"] = {name: _from(path, to) for name, path in cameras.items()}
        data["visibility"] = {"cameras": min(2, len(cameras))}
    data["choice"] = {"count": COUNT, "verify": VERIFY}
    write_text(place, yaml_text(data, COMMENT))


def _from(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder)).as_posix()


def _facing(body: Path) -> Sequence[float]:
    """Direction in which most of the body's targets look, as far as the survey told it."""
    normals = [t.normal for t in read_body(body).targets if t.normal is not None]
    mean = np.mean(normals, axis=0) if normals else np.zeros(3)
    length = float(np.linalg.norm(mean))
    return [round(float(v), 3) for v in mean / length] if length > 0.5 else [0.0, 0.0, 1.0]

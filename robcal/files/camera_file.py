"""Camera files (format robcal/camera-1): interior orientation and, optionally, where the camera stands."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from robcal.errors import InvalidInput
from robcal.files.camera_import import foreign_camera, split_choice
from robcal.files.placement import Placement, placement_data
from robcal.files.schemas import Entry, Number, Positive, read_entry, shown
from robcal.files.storage import write_text
from robcal.files.yaml_io import FlowMapping, yaml_text
from robcal.photogrammetry.core.adjustable import plain
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera
from robcal.photogrammetry.core.lenses import FISHEYE_NAMES, RATIONAL_NAMES, FisheyeCamera, RationalCamera
from robcal.photogrammetry.core.splined import LEAST_NODES, SplinedCamera
from robcal.transforms import Array

FORMAT = "robcal/camera-1"
MODELS: tuple[tuple[type[Camera], str], ...] = ((FisheyeCamera, "fisheye"), (SplinedCamera, "splined"))
MAX_PIXELS = 100_000
CORNER = 0.12
"""A principal point nearer to the top-left corner (of the sides) is one counted from the middle."""


def _side(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 < value <= MAX_PIXELS:
        raise ValueError(f"must be a whole number of pixels between 1 and {MAX_PIXELS}, found {shown(value)}")
    return value


Side = Annotated[int, BeforeValidator(_side)]


class SplineEntry(Entry):
    """Control points of a splined lens: rows of shifts, px."""

    dx_px: list[list[Number]]
    dy_px: list[list[Number]]


class CameraEntry(Entry):
    """The whole file."""

    format: Literal["robcal/camera-1"]
    width: Side
    height: Side
    model: Literal["opencv", "fisheye", "splined"] = "opencv"
    fx: Positive
    fy: Positive
    cx: Number
    cy: Number
    k1: Number = 0.0
    k2: Number = 0.0
    p1: Number = 0.0
    p2: Number = 0.0
    k3: Number = 0.0
    k4: Number | None = None
    k5: Number | None = None
    k6: Number | None = None
    s1: Number | None = None
    s2: Number | None = None
    s3: Number | None = None
    s4: Number | None = None
    spline: SplineEntry | None = None
    pixel_um: Positive | None = None
    world_T_camera: Placement | None = None
    flange_T_camera: Placement | None = None
    base_T_camera: Placement | None = None
    sigmas: dict[str, Number] = Field(default_factory=dict)


@dataclass(frozen=True)
class CameraFile:
    """Content of a camera file.

    Attributes
    ----------
    world_T_camera : (4, 4) where the camera stands, if the file says so.
    pixel_um : size of a pixel, for reports only.
    sigmas : standard deviations of the interior orientation by name, where known.
    flange_T_camera, base_T_camera : (4, 4) of a camera in the hand of a robot, or beside it.
    """

    camera: Camera
    world_T_camera: Array | None = None
    pixel_um: float | None = None
    sigmas: dict[str, float] | None = None
    flange_T_camera: Array | None = None
    base_T_camera: Array | None = None


def read_camera(path: Path | str) -> CameraFile:
    """Read a camera file, the project's own or one of OpenCV, ROS, Kalibr (``camchain.yaml#cam1``) or Metashape.

    Raises
    ------
    InvalidInput : the file contradicts its format or itself (principal point far outside the image).
    """
    file, choice = split_choice(path)
    foreign = foreign_camera(file, choice)
    if foreign is not None:
        _check(foreign, {name: str(file) for name in foreign.names})
        return CameraFile(foreign)
    entry, document = read_entry(file, CameraEntry, FORMAT)
    camera = _camera(entry, str(file))
    _check(camera, {name: f"{file}, line {document.line((name,))}" for name in camera.names})
    return CameraFile(
        camera=camera,
        world_T_camera=entry.world_T_camera.matrix() if entry.world_T_camera else None,
        pixel_um=entry.pixel_um,
        sigmas=dict(entry.sigmas) or None,
        flange_T_camera=entry.flange_T_camera.matrix() if entry.flange_T_camera else None,
        base_T_camera=entry.base_T_camera.matrix() if entry.base_T_camera else None,
    )


def _camera(entry: CameraEntry, file: str) -> Camera:
    """The camera with the lens that its entries tell: fisheye, rational where it has more than Brown's terms."""
    given = {name for name in (*RATIONAL_NAMES, "k4") if getattr(entry, name)}
    if entry.model == "splined" or entry.spline is not None:
        return _splined(entry, file)
    kind: type[Camera] = Camera
    if entry.model == "fisheye":
        if extra := sorted(given - set(FISHEYE_NAMES)):
            raise InvalidInput(f"{file}: a fisheye lens has k1 to k4 and no {', '.join(extra)}: remove them")
        kind = FisheyeCamera
    elif any(getattr(entry, name) is not None for name in RATIONAL_NAMES[len(INTRINSIC_NAMES) :]):
        kind = RationalCamera
    blank = kind(entry.width, entry.height, entry.fx, entry.fy, entry.cx, entry.cy)
    return blank.with_vector([getattr(entry, name) or 0.0 for name in blank.names])


def _splined(entry: CameraEntry, file: str) -> SplinedCamera:
    """Brown's lens with splines.

    Raises
    ------
    InvalidInput : splines without ``model: splined`` or the reverse, terms of other lenses, tables that do not fit.
    """
    if entry.spline is None or entry.model != "splined":
        raise InvalidInput(
            f"{file}: 'model: splined' and 'spline' (dx_px, dy_px) belong together: give both or neither"
        )
    others = RATIONAL_NAMES[len(INTRINSIC_NAMES) :]
    if extra := [name for name in others if getattr(entry, name)]:
        raise InvalidInput(f"{file}: a splined lens has k1 to k3, p1, p2 and no {', '.join(extra)}: remove them")
    dx, dy = entry.spline.dx_px, entry.spline.dy_px
    widths = {len(row) for row in (*dx, *dy)}
    if len(dx) != len(dy) or len(widths) != 1 or min(len(dx), *widths) < LEAST_NODES:
        raise InvalidInput(
            f"{file}: dx_px and dy_px of 'spline' need as many rows and columns as one another, {LEAST_NODES} or more"
        )
    numbers = [getattr(entry, name) for name in INTRINSIC_NAMES]
    nodes = np.stack([np.array(dx, dtype=float), np.array(dy, dtype=float)], axis=-1)
    return replace(SplinedCamera(entry.width, entry.height, *numbers), nodes=nodes)


def _check(camera: Camera, where: Mapping[str, str]) -> None:
    """Refuse what is no interior orientation in pixels; ``where`` is the place of each number, for the message."""
    size = f"an image of {camera.width} x {camera.height} px"
    for name, side in (("cx", camera.width), ("cy", camera.height)):
        value = getattr(camera, name)
        if not -side <= value <= 2 * side:
            raise InvalidInput(
                f"{where[name]}: {name} = {value:g} lies far outside {size}: it is in pixels, usually near the middle"
            )
    if abs(camera.cx) < CORNER * camera.width and abs(camera.cy) < CORNER * camera.height:
        x, y = camera.cx + (camera.width - 1) / 2, camera.cy + (camera.height - 1) / 2
        raise InvalidInput(
            f"{where['cx']}: the principal point ({camera.cx:g}, {camera.cy:g}) lies in the corner of {size}, as if "
            f"counted from the middle: count it from the centre of the top-left pixel, then it is ({x:g}, {y:g})"
        )
    for name in ("fx", "fy"):
        if getattr(camera, name) < 0.05 * max(camera.width, camera.height):
            raise InvalidInput(
                f"{where[name]}: {name} = {getattr(camera, name):g} is too short for {size}: it is in pixels (focal "
                "length in mm divided by the pixel size)"
            )


def write_camera(path: Path | str, content: CameraFile, comment: str = "") -> None:
    """Write a camera file atomically, with the lens that the camera has."""
    camera = plain(content.camera)
    data: dict[str, Any] = {"format": FORMAT, "width": camera.width, "height": camera.height}
    data["model"] = next((m for kind, m in MODELS if isinstance(camera, kind)), "opencv")
    data.update({name: float(getattr(camera, name)) for name in camera.names})
    if isinstance(camera, SplinedCamera):
        data["spline"] = {f"d{axis}_px": camera.nodes[..., k].tolist() for k, axis in enumerate("xy")}
    if content.pixel_um is not None:
        data["pixel_um"] = float(content.pixel_um)
    for name in ("world_T_camera", "flange_T_camera", "base_T_camera"):
        placed = getattr(content, name)
        if placed is not None:
            data[name] = placement_data(placed)
    if content.sigmas:
        data["sigmas"] = FlowMapping({name: float(value) for name, value in content.sigmas.items()})
    write_text(Path(path), yaml_text(data, comment))

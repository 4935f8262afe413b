"""Camera files of other programs as the project's own camera: OpenCV, ROS, Kalibr, Metashape.

All but Metashape count pixels as OpenCV does, from the centre of the top-left one, and name its coefficients. Metashape
(Agisoft, Metashape User Manual, appendix "Camera models") counts the principal point from the middle of the image, puts
(0.5, 0.5) into the centre of the top-left pixel, and names the two tangential coefficients the other way round.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np

from robcal.errors import InvalidInput
from robcal.files.storage import read_bytes
from robcal.files.yaml_io import read_yaml
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.lenses import FisheyeCamera, RationalCamera
from robcal.transforms import Array

_MAX_BYTES = 1_000_000
_MOST_PIXELS = 100_000
_WIDTH = ("imagewidth", "width")
_HEIGHT = ("imageheight", "height")
_SIZE = ("imagesize", "resolution", "size")
_MATRIX = ("cameramatrix", "intrinsicmatrix", "intrinsics", "k", "mtx", "m")
_DISTORTION = ("distortioncoefficients", "distortioncoeffs", "distcoeffs", "distortion", "d", "dist")
_FISHEYE = {"equidistant", "equi", "fisheye", "kannalabrandt4", "pinholeequi"}
_BROWN = {"", "plumbbob", "radtan", "rationalpolynomial", "pinhole", "brown", "opencv"}


def split_choice(path: Path | str) -> tuple[Path, str | None]:
    """File and camera of ``camchain.yaml#cam1``; no camera where none is named."""
    name, mark, choice = str(path).rpartition("#")
    return (Path(name), choice) if mark and not Path(path).exists() else (Path(path), None)


def foreign_camera(path: Path, choice: str | None = None) -> Camera | None:
    """Camera of a file of another program; None if the file is none of these (the project's own, or unknown).

    Raises
    ------
    InvalidInput : such a file without a size or camera matrix, or with a lens model that has no counterpart.
    """
    text = read_bytes(path, _MAX_BYTES).decode("utf-8-sig", errors="replace")
    if re.search(r"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise InvalidInput(f"{path}: declares a document type or entities, which is refused: remove them")
    if "<opencv_storage" in text or "!!opencv-matrix" in text or text.startswith("%YAML:"):
        return _from_entries(path, _opencv_entries(path, text))
    if text.lstrip().startswith("<"):
        return _metashape(path, text)
    data = read_yaml(path).data
    if "format" in data:
        return None
    chain = {k: v for k, v in data.items() if isinstance(v, Mapping) and "intrinsics" in v}
    if chain:
        if (name := choice or "cam0") not in chain:
            raise InvalidInput(f"{path}: has no camera '{name}': name one of {', '.join(chain)} as {path.name}#NAME")
        return _from_entries(path, chain[name])
    known = {_plain(key) for key in data}
    return _from_entries(path, data) if known & {*_MATRIX, *_DISTORTION} else None


def _plain(key: str) -> str:
    return re.sub(r"[^a-z0-9]", "", str(key).lower())


def _opencv_entries(path: Path, text: str) -> dict[str, Any]:
    """All entries of a file of cv::FileStorage; matrices as arrays."""
    if not text.lstrip().startswith(("%YAML", "<")):
        text = "%YAML:1.0\n---\n" + text
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        return {key: _value(root.getNode(key)) for key in root.keys()}  # noqa: SIM118 (no mapping)
    except (cv2.error, SystemError) as error:
        raise InvalidInput(f"{path}: not a file that OpenCV wrote: {' '.join(str(error).split())[:200]}") from None


def _value(node: cv2.FileNode) -> Any:
    if node.isMap():
        return node.mat()
    if node.isSeq():
        return [node.at(k).real() for k in range(node.size())]
    return node.string() if node.isString() else node.real()


def _from_entries(path: Path, data: Mapping[str, Any]) -> Camera:
    entries = {_plain(key): value for key, value in data.items()}

    def first(names: Sequence[str]) -> Any:
        return next((entries[name] for name in names if entries.get(name) is not None), None)

    size = first(_SIZE) or (first(_WIDTH), first(_HEIGHT))
    if len(size) != 2 or None in size:
        raise InvalidInput(f"{path}: the size of the images is missing: add image_width and image_height")
    K, D = _numbers(path, first(_MATRIX), "camera matrix"), _numbers(path, first(_DISTORTION), "distortion")
    if K.size == 4:
        fx, fy, cx, cy = K
    elif K.size == 9:
        fx, skew, cx, _, fy, cy = K[:6]
        if abs(skew) > 1e-9 * abs(fx):
            raise InvalidInput(
                f"{path}: the camera matrix has a skew of {skew:g}, which no lens here has: calibrate without"
            )
    else:
        raise InvalidInput(f"{path}: no camera matrix (3 x 3, or the four numbers fx, fy, cx, cy)")
    model = _plain(str(first(("distortionmodel", "cameramodel")) or ""))
    sides = _numbers(path, list(size), "the image size")
    if sides.size != 2 or not np.all((sides >= 1) & (sides <= _MOST_PIXELS)):
        raise InvalidInput(f"{path}: the image size must be two whole numbers of pixels up to {_MOST_PIXELS}")
    width, height = int(sides[0]), int(sides[1])
    start = (width, height, 1.0, 1.0, 0.0, 0.0)
    if model in _FISHEYE or entries.get("fisheyemodel"):
        if D.size not in (0, 4):
            raise InvalidInput(f"{path}: a fisheye lens has four coefficients (k1 to k4), found {D.size}")
        return FisheyeCamera(*start).with_vector([fx, fy, cx, cy, *np.append(D, np.zeros(4 - D.size))])
    if model not in _BROWN:
        raise InvalidInput(
            f"{path}: lens model '{model}' has no counterpart here: calibrate with OpenCV's standard or fisheye model "
            "(ROS plumb_bob, rational_polynomial, equidistant; Kalibr pinhole-radtan, pinhole-equi), or leave the "
            "start values out: the camera is then self-calibrated"
        )
    if np.any(D[12:] != 0.0):
        raise InvalidInput(
            f"{path}: has {D.size} distortion coefficients; a tilted sensor (tau) has no counterpart here: calibrate "
            "without CALIB_TILTED_MODEL"
        )
    kind, most = (RationalCamera, 12) if np.any(D[5:] != 0.0) else (Camera, 5)
    coefficients = np.append(D[:most], np.zeros(max(0, most - D.size)))
    return kind(*start).with_vector([fx, fy, cx, cy, *coefficients])


def _numbers(path: Path, value: Any, what: str) -> Array:
    if isinstance(value, Mapping):
        value = value.get("data")
    try:
        numbers = np.ravel(np.asarray([] if value is None else value, dtype=float))
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    if not np.all(np.isfinite(numbers)):
        raise InvalidInput(f"{path}: {what} must be finite numbers")
    return numbers


def _metashape(path: Path, text: str) -> Camera:
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InvalidInput(f"{path}: its XML is broken: {error}") from None
    calibration = root if root.tag == "calibration" else root.find(".//calibration")
    if calibration is None:
        raise InvalidInput(f"{path}: neither OpenCV's nor Metashape's XML: convert it to format robcal/camera-1")
    kind = calibration.findtext("projection", calibration.get("type", "frame"))
    if kind != "frame":
        raise InvalidInput(f"{path}: projection '{kind}' has no counterpart here: export a frame camera")
    resolution = calibration.find("resolution")
    size = dict(resolution.attrib) if resolution is not None else {}
    values: dict[str, float] = {}
    for name in (
        "width",
        "height",
        "f",
        "fx",
        "fy",
        "cx",
        "cy",
        "k1",
        "k2",
        "k3",
        "k4",
        "p1",
        "p2",
        "b1",
        "b2",
        "skew",
    ):
        given = calibration.findtext(name, size.get(name))
        try:
            values[name] = float(given) if given else 0.0
        except ValueError:
            raise InvalidInput(f"{path}: <{name}> must be a number, found '{given}'") from None
    if not (values["width"] and values["height"] and values["f"]):
        raise InvalidInput(f"{path}: width, height or f is missing: export the calibration as Metashape's own XML")
    if extra := [name for name in ("k4", "b2") if values[name] != 0.0]:
        raise InvalidInput(f"{path}: {', '.join(extra)} has no counterpart here: adjust without it")
    if not all(np.isfinite(v) for v in values.values()) or min(values["width"], values["height"]) < 1:
        raise InvalidInput(f"{path}: width, height and all coefficients must be finite, the size at least one pixel")
    if max(values["width"], values["height"]) > _MOST_PIXELS:
        raise InvalidInput(f"{path}: an image side of more than {_MOST_PIXELS} pixels: check width and height")
    width, height = int(values["width"]), int(values["height"])
    fy = values["f"]
    fx = fy + values["b1"]
    cx, cy = width / 2 + values["cx"] - 0.5, height / 2 + values["cy"] - 0.5
    return Camera(width, height, fx, fy, cx, cy, values["k1"], values["k2"], values["p2"], values["p1"], values["k3"])

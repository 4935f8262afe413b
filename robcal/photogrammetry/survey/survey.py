"""Survey of a measuring body: from detected or identified image points to coordinates with full covariance.

Bodies without codes: dots with given coordinates are identified from their arrangement, image by image.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from robcal.errors import InvalidInput
from robcal.photogrammetry.bundle.colmap_engine import adjust_with_colmap
from robcal.photogrammetry.bundle.datum import DatumSpec
from robcal.photogrammetry.core.adjustable import adjustable, adjustable_names
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.discs import facing_normals
from robcal.photogrammetry.core.network import CameraNetwork, Lengths
from robcal.photogrammetry.identify.targets import identify_targets
from robcal.photogrammetry.survey.adjusting import first_adjustment
from robcal.photogrammetry.survey.final_frame import FinalSurvey, adjust_in_final_frame
from robcal.photogrammetry.survey.identification import identify_uncoded
from robcal.photogrammetry.survey.images import collect
from robcal.photogrammetry.survey.types import BodyTarget, SurveyImage, SurveyInput, SurveyResult, SurveySettings

_FACTORS = (1.2, 2.0, 3.2, 0.8)
"""Focal lengths to try without a camera file, in units of the longer side."""
_TRIAL_IMAGES = 6


def needs_geometry(images: Sequence[SurveyImage], targets: Sequence[BodyTarget]) -> bool:
    """True if no image shows four codes and at least four uncoded dots have coordinates."""
    dots = [t for t in targets if t.code is None and t.id is not None and t.xyz is not None]
    if len(dots) < 4:
        return False
    codes = {t.id for t in targets if t.code is not None}
    for image in images:
        if image.marks is not None:
            return False
        if image.detections is not None:
            read = image.detections.code[image.detections.code >= 0]
            if len([c for c in read.tolist() if not codes or c in codes]) >= 4:
                return False
    return True


def identify_by_geometry(
    images: Sequence[SurveyImage], targets: Sequence[BodyTarget], size: tuple[int, int], camera: Camera | None
) -> list[SurveyImage]:
    """The images with ids in the place of codes where the arrangement of the dots was unambiguous.

    Without a camera file a few focal lengths are tried on the first images. Weakness: symmetric arrangements (a regular
    grid) cannot be identified; their images stay without ids.
    """
    known = [t for t in targets if t.id is not None and t.xyz is not None]
    body = Body(
        "survey",
        np.array([t.id for t in known], dtype=np.int64),
        np.array([t.xyz for t in known], dtype=float),
        None,
        tuple(t.code for t in known),
        np.array([t.diameter or np.nan for t in known]),
    )
    error = 0.004 * max(size)
    cameras = [camera] if camera is not None else [Camera.from_size(*size, factor) for factor in _FACTORS]
    trial = [image for image in images if image.detections is not None][:_TRIAL_IMAGES]
    best = max(cameras, key=lambda c: sum(len(_identified(image, body, c, error)[0]) for image in trial))
    out = []
    for image in images:
        rows, ids = _identified(image, body, best, error)
        if len(rows) and image.detections is not None:
            code = np.full(len(image.detections.xy), -1, dtype=np.int64)
            code[rows] = ids
            image = replace(image, detections=replace(image.detections, code=code))
        out.append(image)
    return out


def _identified(image: SurveyImage, body: Body, camera: Camera, error: float) -> tuple[np.ndarray, np.ndarray]:
    if image.detections is None or len(image.detections.xy) < 4:
        none = np.empty(0, dtype=np.int64)
        return none, none
    found = identify_targets(image.detections, body, camera, model_error_px=error)
    return found.rows, found.ids


def survey_body(  # noqa: PLR0913 - options by keyword
    images: Sequence[SurveyImage],
    targets: Sequence[BodyTarget],
    *,
    size: tuple[int, int],
    camera: Camera | None = None,
    scale_bars: Lengths | None = None,
    check_lengths: Lengths | None = None,
    datum: DatumSpec = "free",
    engine: Literal["robcal", "pycolmap"] = "robcal",
    settings: SurveySettings | None = None,
) -> SurveyResult:
    """Survey a body from unordered photographs of one camera.

    Parameters
    ----------
    size : (width, height) of the images in px. camera : start values, or None (then from the image size alone);
        other lenses keep what they have beyond the nine numbers.
    datum : 'free', 'bars' or ids of targets held at their given coordinates.

    Raises
    ------
    InvalidInput : contradictory input or scale bars, an unknown engine.
    DegenerateGeometry : the images cannot be oriented.
    NotIdentifiable : the scale or the interior orientation is not determined.
    """
    settings = settings or SurveySettings()
    if camera is not None:
        camera = adjustable(camera)
        carried = tuple(name for name in settings.free_intrinsics if name in adjustable_names(camera))
        settings = replace(settings, free_intrinsics=carried)
        if engine == "pycolmap" and type(camera) is not Camera:
            raise InvalidInput("engine pycolmap adjusts Brown's lens alone: use engine robcal with this camera file")
    bars, checks = scale_bars or Lengths.none(), check_lengths or Lengths.none()
    if engine not in ("robcal", "pycolmap"):
        raise InvalidInput(f"bundle engine {engine!r} is unknown: choose robcal or pycolmap")
    if camera is not None and (camera.width, camera.height) != tuple(size):
        raise InvalidInput(
            f"the images are {size[0]} x {size[1]} px but the camera file says {camera.width} x {camera.height}: "
            "give the calibration of this camera at this resolution, or none"
        )
    if needs_geometry(images, targets):
        images = identify_by_geometry(images, targets, size, camera)
        # now the ids stand for codes, whatever the body's file says
        targets = [replace(t, code=t.code or "by geometry") if t.xyz is not None else t for t in targets]
    ends = np.concatenate([bars.ids.ravel(), checks.ids.ravel()])
    given = SurveyInput(
        collect(images, targets, ends),
        tuple(targets),
        camera or Camera.from_size(*size),
        camera is not None,
        bars,
        checks,
        settings,
    )
    given.check_scale(datum)
    table, adjusted = first_adjustment(given)
    table, adjusted = identify_uncoded(given, table, adjusted)
    final = adjust_in_final_frame(given, table, adjusted, datum)
    network = final.adjusted.network
    if engine == "pycolmap":
        network = adjust_with_colmap(network, lengths=bars, check_lengths=checks)
    return _result(given, final, network, engine)


def _result(given: SurveyInput, final: FinalSurvey, network: CameraNetwork, engine: str) -> SurveyResult:
    """The result of a survey from its final adjustment."""
    table, discs = final.table, final.adjusted.discs
    ids = network.ids.tolist()
    unused = dict([*given.detections.unused, *table.unplaced])
    for name in given.detections.names:
        if name not in network.image_names:
            unused.setdefault(name, "too few usable marks were left")
    listed = {t.id for t in given.targets if t.id is not None}
    deviation = np.linalg.norm(network.points - given.given_points(ids), axis=1)
    if discs is None:
        normals = np.full((len(ids), 3), np.nan)
    else:
        normals = facing_normals(network.normals, discs.select(final.adjusted.network.index_of(ids)))
    new_ids = set(table.ids[table.new].tolist()) & set(ids)
    return SurveyResult(
        network=replace(network, rejected=tuple(dict.fromkeys(table.rejected))),
        frame=final.frame,
        scale=final.scale,
        new_ids=tuple(sorted(new_ids - listed)),
        unseen_ids=tuple(sorted(listed - set(ids))),
        unused_images=tuple(unused.items()),
        free_detections=int(np.count_nonzero(table.target < 0)),
        deviations=tuple((i, float(d)) for i, d in zip(ids, deviation, strict=True) if np.isfinite(d)),
        engine=engine,
        normals=normals,
        notes=tuple(dict.fromkeys([*given.detections.notes, *final.notes, *network.notes])),
    )


__all__ = ["BodyTarget", "SurveyImage", "SurveyResult", "SurveySettings", "survey_body"]

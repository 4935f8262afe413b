"""Bodies without codes: dots with given coordinates are identified from their arrangement, image by image."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.identify.targets import identify_targets
from robcal.photogrammetry.survey.types import BodyTarget, SurveyImage

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

"""Survey of a measuring body: from detected or identified image points to coordinates with full covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from robcal.errors import InvalidInput
from robcal.photogrammetry.bundle.colmap_engine import adjust_with_colmap
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.network import Lengths
from robcal.photogrammetry.survey.images import collect
from robcal.photogrammetry.survey.steps import Survey
from robcal.photogrammetry.survey.types import BodyTarget, SurveyImage, SurveyResult, SurveySettings
from robcal.photogrammetry.survey.uncoded import identify_by_geometry, needs_geometry


def survey_body(
    images: Sequence[SurveyImage],
    targets: Sequence[BodyTarget],
    *,
    size: tuple[int, int],
    camera: Camera | None = None,
    scale_bars: Lengths | None = None,
    check_lengths: Lengths | None = None,
    datum: str | tuple[int, ...] = "free",
    engine: Literal["robcal", "pycolmap"] = "robcal",
    settings: SurveySettings | None = None,
) -> SurveyResult:
    """Survey a body from unordered photographs of one camera.

    Parameters
    ----------
    size : (width, height) of the images in px. camera : start values, or None (then from the image size alone).
    datum : 'free', 'bars' or ids of targets held at their given coordinates.

    Raises
    ------
    InvalidInput : contradictory input or scale bars, an unknown engine.
    DegenerateGeometry : the images cannot be oriented.
    NotIdentifiable : the scale or the interior orientation is not determined.
    """
    settings = settings or SurveySettings()
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
    work = Survey(collect(images, targets, ends), targets, size, camera, bars, checks, settings)
    work.check_scale(datum)
    network = work.first_adjustment()
    network = work.match(network)
    network, frame, scale = work.finish(network, datum)
    if engine == "pycolmap":
        network = adjust_with_colmap(network, lengths=bars, check_lengths=checks)
    return work.result(network, frame, scale, engine)


__all__ = ["BodyTarget", "SurveyImage", "SurveyResult", "SurveySettings", "survey_body"]

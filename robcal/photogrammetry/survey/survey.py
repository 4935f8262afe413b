"""Survey of a measuring body: from detected or identified image points to coordinates with full covariance."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from robcal.errors import InvalidInput
from robcal.photogrammetry.bundle.colmap_engine import adjust_with_colmap
from robcal.photogrammetry.bundle.datum import DatumSpec
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.discs import facing_normals
from robcal.photogrammetry.core.network import CameraNetwork, Lengths
from robcal.photogrammetry.survey.adjusting import first_adjustment
from robcal.photogrammetry.survey.final_frame import FinalSurvey, adjust_in_final_frame
from robcal.photogrammetry.survey.identification import identify_uncoded
from robcal.photogrammetry.survey.images import collect
from robcal.photogrammetry.survey.inputs import SurveyInput
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
    datum: DatumSpec = "free",
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

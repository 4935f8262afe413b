"""Small surveys and stations of the fixtures at the level of marks, adjusted and ready for the diagnosis."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fixtures.effects import Effect
from fixtures.measuring_effects import swap_labels
from fixtures.sightings import LENS, Marks, Scene, SightingPlan, draw_scene, draw_sighting_effect, sight, view_name
from robcal.diagnosis.images.diagnosis import ImageFinding, diagnose_images
from robcal.diagnosis.images.lens_findings import station_findings
from robcal.diagnosis.images.station import station_data
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.network import Lengths
from robcal.photogrammetry.station.network import StationMarks, StationOrientation
from robcal.photogrammetry.station.orientation import orient_station
from robcal.photogrammetry.survey.survey import BodyTarget, SurveyImage, SurveyResult, survey_body
from robcal.physics.images.data import ImageData


@dataclass(frozen=True)
class Station:
    """An oriented station with what went into it."""

    effects: tuple[Effect, ...]
    names: tuple[str, ...]
    orientation: StationOrientation
    marks: dict[str, StationMarks]
    given: Body
    data: ImageData


def _prepared(causes: Sequence[str], snr: float, plan: dict[str, Any]) -> tuple[Scene, tuple[Effect, ...]]:
    made = SightingPlan(**plan)
    effects = tuple(draw_sighting_effect(made, cause, snr, k) for k, cause in enumerate(causes))
    return draw_scene(replace(made, effects=effects)), effects


def _file_camera(scene: Scene, name: str, effects: Sequence[Effect]) -> Camera:
    true = scene.cameras[name]
    values = {k: getattr(true, k) for k in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")}
    values["fx"] *= 1.001
    values["fy"] *= 1.001
    for e in effects:
        if e.where == name and e.cause in LENS:
            zero = {"fy": values["fx"]} if e.cause == "lens_affinity" else dict.fromkeys(LENS[e.cause], 0.0)
            values |= zero
    return Camera(true.width, true.height, **values)


def _noisy(scene: Scene, marks: Marks, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    sigma = scene.plan.sigma_px
    xy = marks.xy + sigma * rng.standard_normal(marks.xy.shape)
    covariance = np.tile(np.eye(2) * (sigma * scene.plan.stated_factor) ** 2, (len(xy), 1, 1))
    return xy, covariance


def station(*causes: str, snr: float = 12.0, covariates: bool = True, **plan: Any) -> Station:
    """A station whose effects are drawn at random and scaled to the SNR."""
    scene, effects = _prepared(causes, snr, {"kind": "station", "views": 16, "targets": 14, **plan})
    rng = np.random.default_rng([scene.plan.seed, 77])
    labels = np.array(swap_labels(effects, scene.ids))
    marks = {}
    for name, seen in sight(scene, effects).items():
        xy, covariance = _noisy(scene, seen, rng)
        marks[name] = StationMarks(seen.view, labels[seen.target], xy, covariance)
    t = len(scene.ids)
    exactness = np.eye(3 * t) * 2e-6**2
    given = Body("plate", np.array(scene.ids), scene.points, exactness, ("corner",) * t, np.full(t, np.nan))
    cameras = {name: _file_camera(scene, name, effects) for name in scene.cameras}
    orientation = orient_station(marks, given, cameras, {n: (c.width, c.height) for n, c in cameras.items()})
    c = scene.circumstances
    change = {"temp_arm_c": c.temperature["arm"], "hours": c.hours} if covariates else {}
    names = tuple(view_name(i) for i in range(scene.plan.views))
    return Station(effects, names, orientation, marks, given, station_data(orientation, names, given, cameras, change))


def reported(scene: Station) -> list[ImageFinding]:
    """What the adjustment found by itself and what the scan finds after it."""
    alone = station_findings(scene.orientation, scene.names, scene.given, scene.data.inflation)
    return [*alone, *diagnose_images(scene.data).findings]


def survey(*causes: str, snr: float = 12.0, **plan: Any) -> tuple[SurveyResult, Camera]:
    """A survey and the camera as its file has it."""
    scene, effects = _prepared(causes, snr, {"kind": "survey", "views": 16, "targets": 20, **plan})
    rng = np.random.default_rng([scene.plan.seed, 78])
    seen = sight(scene, effects)["survey"]
    xy, covariance = _noisy(scene, seen, rng)
    ids = np.array(scene.ids)
    images = [
        SurveyImage(view_name(v), marks=(ids[seen.target[rows]], xy[rows], covariance[rows]))
        for v in range(scene.plan.views)
        if len(rows := np.flatnonzero(seen.view == v))
    ]
    camera = _file_camera(scene, "survey", effects)
    bars = Lengths(ids[[[0, 1]]], np.array([np.linalg.norm(scene.points[0] - scene.points[1])]), np.array([5e-6]))
    targets = [BodyTarget(int(i), "corner") for i in ids]
    done = survey_body(images, targets, size=(camera.width, camera.height), camera=camera, scale_bars=bars)
    return done, camera
